"""The folder that a run leaves behind: results of every finished stage, and metrics.json that says how far it got."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.commands.dense_outputs import remove_dense_outputs
from torchrefrac.commands.memory import memory_lack_explained
from torchrefrac.commands.results import (
    FURTHER,
    MODEL,
    MODEL_FILES,
    RESULTS,
    further_folders,
    further_results,
    has_model,
    require_own,
    run_record,
)
from torchrefrac.figures.side_views import draw_side_views, side_view
from torchrefrac.files.cameras import write_cameras, write_points
from torchrefrac.files.colmap.model import write_colmap
from torchrefrac.files.colmap.tables import Ids
from torchrefrac.files.run import METRICS, PAGES, REPORT, RunRecord
from torchrefrac.files.swap import remove_if_empty
from torchrefrac.files.tracks import write_tracks
from torchrefrac.files.water import WATER, write_water
from torchrefrac.geometry import Similarity
from torchrefrac.numerics import segment_sum
from torchrefrac.record.memory import forget_peak_memory, peak_memory_gib
from torchrefrac.scene import Capture, Scene, Truth
from torchrefrac.sfm import looks_through_wall

DENSE, DENSE_METRICS = "dense", ("dense_", "seconds_dense")  # the stage, and how the names of its metrics begin


class RunFolder:
    """Writes each result under a temporary name and renames it. with_model: a COLMAP model, too."""

    def __init__(self, folder: Path, with_model: bool = False) -> None:
        self.folder, self.with_model = folder, with_model
        self.metrics: dict[str, Any] = {}

    @contextmanager
    def recording(self, **about: Any) -> Iterator[None]:
        """Keep metrics.json true: "complete", or "failed" / "interrupted" with the reason and the last stage done.

        Results of an earlier run in the same folder are removed first, so that the folder tells of one run;
        `results_in` is for those that should stay until there are new ones. Only what a dense stage had finished before
        it was interrupted stays, for the next one to go on with. Raises OptionError where what lies there is of no run.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        require_own(self.folder, self.with_model)
        before = run_record(self.folder)
        model = MODEL_FILES if before is not None and has_model(before) else ()
        for name in (*RESULTS, *model, *further_results(self.folder), REPORT):
            (self.folder / name).unlink(missing_ok=True)
            remove_if_empty((self.folder / name).parent, self.folder)
        remove_dense_outputs(self.folder)
        self.metrics = {"status": "running", "stages": [], **about} | ({MODEL: True} if self.with_model else {})
        self.save_metrics()
        with self._until_the_end():
            yield

    @contextmanager
    def recording_dense(self) -> Iterator[None]:
        """The same for a dense stage alone: the results and metrics of all others stay, as metrics.json has them."""
        found = read_record(self.folder)
        about = found.metrics.items()
        kept = {name: value for name, value in about if not name.startswith(DENSE_METRICS) and name != "reason"}
        self.metrics = kept | {"status": "running", "stages": [name for name in found.stages if name != DENSE]}
        self.save_metrics()
        for name in PAGES:  # which tell of what was
            (self.folder / name).unlink(missing_ok=True)
        remove_dense_outputs(self.folder)
        with self._until_the_end():
            yield

    def save_metrics(self) -> None:
        """Write metrics.json as it is now, for long stages that may come to a sudden end."""
        RunRecord.of(self.folder, self.metrics).write()

    def stage_done(self, name: str, product: Any, seconds: float) -> None:
        """Write what a stage made; which pairs are matched is a part of matching."""
        if name == "pairs":
            self.metrics |= product.metrics
            self.save_metrics()
            return
        if name == "features":
            pixels = {f"pixels_{i:04d}": found.pixels for i, found in enumerate(product)}
            _write_arrays(pixels, self.folder / "features.npz")
        elif name == "levelling":
            self.metrics |= _levelled(product)
        elif name == "matching":
            pairs = [verified.pair for verified in product]
            matches = {f"matches_{pair.first:04d}_{pair.second:04d}": pair.matches for pair in pairs}
            _write_arrays(matches, self.folder / "matches.npz")
        elif name == "sparse":
            self._write(product, self.folder)
            for scene, folder in zip(product.further, further_folders(self.folder), strict=False):
                self._write(scene, folder)
                self.metrics.setdefault(FURTHER, {})[folder.name] = len(scene.views)
        self.metrics["stages"].append(name)
        self.metrics[f"seconds_{name}"] = round(seconds, 3)
        self.save_metrics()

    def complete(
        self, scene: Scene, metrics: dict[str, Any], truth: Truth | None, alignment: Similarity | None
    ) -> None:
        """Take in the metrics and draw the figure."""
        self.metrics |= metrics
        if scene.failures:
            self.metrics["not_registered"] = dict(scene.failures)
        view = side_view(self.metrics["model"], scene, alignment, self.metrics)
        draw_side_views([view], truth if alignment is not None else None, self.folder / "side_view.png")

    def _write(self, scene: Scene, folder: Path) -> None:
        write_scene(scene, folder)
        if self.with_model:
            write_model(scene, folder, binary=True)

    @contextmanager
    def _until_the_end(self) -> Iterator[None]:
        start = time.perf_counter() - sum(self.metrics.get(f"seconds_{stage}", 0.0) for stage in self.metrics["stages"])
        forget_peak_memory()
        try:
            with memory_lack_explained():
                yield
        except KeyboardInterrupt:
            self._end("interrupted", start, "stopped by the user")
            raise
        except Exception as error:
            self._end("failed", start, str(error) or type(error).__name__)
            raise
        self._end("complete", start)

    def _end(self, status: str, start: float, reason: str = "") -> None:
        self.metrics["status"] = status
        if reason:
            self.metrics["reason"] = reason
        self.metrics["seconds_total"] = round(time.perf_counter() - start, 3)
        memory = peak_memory_gib()
        if memory is not None:
            self.metrics["peak_memory_gib"] = round(memory, 3)
        self.save_metrics()


def write_scene(scene: Scene, folder: Path) -> None:
    """Write cameras, points and tracks into a folder, which is made where there is none."""
    write_cameras(scene, folder / "cameras.json")
    write_points(scene.points, scene.colors, folder / "points.ply", scene.assessment, scene.dry)
    write_tracks(scene, folder / "tracks.npz")


def write_model(scene: Scene, folder: Path, binary: bool, ids: Ids | None = None) -> None:
    """Write the same as a COLMAP model into a folder, with its water beside it. ids: see `write_colmap`."""
    point, n = scene.observations.point, len(scene.points)
    errors = segment_sum(scene.errors()[:, None], point, n)[:, 0] / torch.bincount(point, minlength=n)
    write_colmap(scene, folder / MODEL, binary, errors, ids)
    write_water(scene, folder / WATER)


def read_record(folder: Path) -> RunRecord:
    """The record of a run; without a metrics.json nothing is known, and no stage complete.

    Raises RunRecordError where it is damaged.
    """
    return RunRecord.read(folder) if (folder / METRICS).is_file() else RunRecord(folder)


def _levelled(capture: Capture) -> dict[str, Any]:
    """What was found of the verticals of a capture, or of the normals of the walls that it looks through."""
    if not looks_through_wall(capture):
        return capture.gravity_metrics | {"gravity": "estimated"}
    return {"wall_normal": "estimated", "wall_normal_sigma_deg": capture.gravity_metrics["gravity_sigma_deg"]}


def _write_arrays(arrays: Mapping[str, Shaped[Tensor, "..."]], path: Path) -> None:
    plain = {name: array.numpy() for name, array in arrays.items()}
    with replacing(path) as temporary:
        np.savez_compressed(temporary, **plain)  # type: ignore[arg-type]
