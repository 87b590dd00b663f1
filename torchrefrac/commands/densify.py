"""The dense stage: after a reconstruction, or on the folder that one has left behind."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.commands.dense_outputs import remove_if_empty, write_dense_outputs
from torchrefrac.commands.run_folder import DENSE, RunFolder, read_record
from torchrefrac.config import DensifyOptions, OptionError
from torchrefrac.config.outputs import DenseOutputs
from torchrefrac.dense import DenseError, DenseOptions, FolderStore, densify
from torchrefrac.dense.patches import Patches
from torchrefrac.evaluate.dense_metrics import evaluate_dense, summarize_dense, textured_points
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.figures.dense import dense_view, draw_dense_views
from torchrefrac.figures.error_map import draw_error_map, error_panel
from torchrefrac.files.capture import load_capture, read_grey
from torchrefrac.files.run import DENSE_VIEW, DEPTH_MAPS, ERROR_MAP, PARTS
from torchrefrac.files.tracks import CAMERAS, read_run
from torchrefrac.files.truth import load_truth
from torchrefrac.files.truth_points import load_truth_points
from torchrefrac.geometry import Similarity
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, CaptureError, DenseCloud, Scene, SceneError, Truth


class SparseRun(NamedTuple):
    """A run folder with its sparse model, and the photographs of that model's images, in the same order."""

    folder: Path
    capture: Capture
    scene: Scene


def densify_run(run: SparseRun, options: DensifyOptions, recorder: Recorder) -> dict[str, Any]:
    """Make a run dense and leave the results in its folder, beside those of its other stages. Returns the metrics.

    Dense results that lie there are replaced. What a dense stage that was interrupted has finished is gone on with,
    where options, photographs and cameras are still the same.
    """
    files = RunFolder(run.folder)
    with files.recording_dense():
        truth = load_truth(run.capture.folder)
        aligned = None if truth is None else evaluate(run.scene, truth)[1]
        dense_stage(files, run.capture, run.scene, options.dense, options.outputs, truth, aligned, recorder)
    return files.metrics


def dense_stage(
    files: RunFolder,
    capture: Capture,
    scene: Scene,
    options: DenseOptions,
    outputs: DenseOutputs,
    truth: Truth | None,
    aligned: Similarity | None,
    recorder: Recorder,
) -> None:
    """Densify, evaluate where `aligned` maps the cameras to those of the truth, and write everything.

    Every image's patches are kept in the run folder until all is written. Raises DenseError where nothing is found, and
    what `densify` raises.
    """
    folder = files.folder
    files.save_metrics()
    parts = FolderStore(folder / PARTS, scene, capture, options)
    store, start = _CountingStore(parts), time.perf_counter()
    dense = densify(scene, capture, options, recorder, store)
    seconds = time.perf_counter() - start
    cloud = dense.cloud
    if not len(cloud):
        raise DenseError(
            "no patch of the surface looks the same in several images; it must have texture, and the photographs must "
            "be sharp"
        )
    files.metrics |= {"dense_method": options.method} | store.metrics(seconds) | summarize_dense(cloud)
    if truth is not None and aligned is not None:
        with recorder.meter(1, "evaluating", "") as advance:
            seen = _points_to_be_found(capture)
            files.metrics |= evaluate_dense(cloud, truth, aligned, seen)
            advance(1, "")
    write_dense_outputs(dense, scene, options, outputs, recorder, folder)
    with recorder.meter(1, "drawing", "") as advance:
        _draw(files, cloud, scene, truth, aligned)
        advance(1, "")
    files.stage_done(DENSE, dense, seconds)
    parts.clear()
    remove_if_empty(folder / DEPTH_MAPS)
    recorder.cloud(DENSE, cloud.points, cloud.colors, 0)


def open_run(folder: Path, capture: str | None = None) -> SparseRun:
    """Read the sparse model of a run, and its photographs from where metrics.json says, or from the folder `capture`.

    Changes nothing. Raises OptionError, SceneError or CaptureError, with what is missing, where one of them is not
    there or they do not belong together.
    """
    if not folder.is_dir():
        raise OptionError(f"run is {folder}, which is no folder; name one that a run has left behind")
    if not (folder / CAMERAS).is_file():
        raise SceneError(
            f"{folder} holds no {CAMERAS}, so there is no sparse model to begin with: run `torchrefrac` first (after "
            "`torchrefrac adjust` there is one where the water is the plane z = 0 and the images share one lens)"
        )
    scene = read_run(folder)
    photographs = load_capture(_capture_folder(folder, capture))
    _require_same_size(photographs, scene, folder)
    row = {name: i for i, name in enumerate(photographs.names)}
    views = list(zip(scene.views.names, scene.views.registered.tolist(), strict=True))
    lost = [name for name, registered in views if registered and name not in row]
    if lost:
        raise CaptureError(
            f"{photographs.folder / 'capture.json'} does not list {', '.join(lost)}, whose pose is in "
            f"{folder / CAMERAS}; take both from the same photographs"
        )
    scene = scene.of_views(torch.tensor([name in row for name, _ in views]))
    return SparseRun(folder, photographs.of_views([row[name] for name in scene.views.names]), scene)


class _CountingStore:
    """Counts the patches that pass through to another store and back."""

    def __init__(self, store: FolderStore) -> None:
        self._store = store
        self._new = self._old = self._images = 0

    def load(self, image: int) -> Patches | None:
        patches = self._store.load(image)
        if patches is not None:
            self._old, self._images = self._old + len(patches), self._images + 1
        return patches

    def save(self, image: int, patches: Patches) -> None:
        self._new += len(patches)
        self._store.save(image, patches)

    def metrics(self, seconds: float) -> dict[str, Any]:
        """How many patches there were before any was filtered out, and how fast they were found."""
        found: dict[str, Any] = {"dense_patches": self._old + self._new}
        if self._new:
            found["dense_patches_per_s"] = round(self._new / seconds, 1)
        if self._images:
            found["dense_images_resumed"] = self._images
        return found


def _draw(files: RunFolder, cloud: DenseCloud, scene: Scene, truth: Truth | None, aligned: Similarity | None) -> None:
    metrics = files.metrics
    model = metrics.get("model", "refractive" if scene.index_ratio > 1.0 else "none")
    view = dense_view(model, cloud, scene, aligned, metrics)
    draw_dense_views([view], truth if aligned is not None else None, files.folder / DENSE_VIEW)
    if truth is not None and aligned is not None and len(truth.corner):
        draw_error_map([error_panel(model, cloud, aligned, truth, metrics)], truth, files.folder / ERROR_MAP)


def _points_to_be_found(capture: Capture) -> Float[Tensor, "n 3"] | None:
    """True points that the photographs show well; None where nobody knows them."""
    known = load_truth_points(capture.folder, capture.names)
    if known is None:
        return None
    paths = dict(zip(capture.names, capture.paths, strict=True))
    try:
        return textured_points(known, [torch.from_numpy(read_grey(paths[name])) for name in known.names])
    except ValueError as error:
        raise CaptureError(f"{capture.folder / 'truth_points.npz'}: {error}") from None


def _capture_folder(folder: Path, given: str | None) -> Path:
    if given is not None:
        return Path(given)
    known = read_record(folder).capture
    if known is None:
        raise OptionError(
            f"capture is missing, and {folder / 'metrics.json'} does not say where the photographs are; give the "
            "folder that holds capture.json and images/ as capture=DIR"
        )
    if not known.is_dir():
        raise CaptureError(
            f"the photographs of {folder} were in {known}, which is no longer there; say where they are as capture=DIR"
        )
    return known


def _require_same_size(capture: Capture, scene: Scene, folder: Path) -> None:
    found, wanted = (f"{camera.width}x{camera.height}" for camera in (capture.intrinsics, scene.intrinsics))
    if found != wanted:
        raise CaptureError(
            f"the photographs in {capture.folder} are {found}, but those of {folder} were {wanted}; give those"
        )
