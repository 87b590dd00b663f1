"""The dense stage: after a reconstruction, or on the folder that one has left behind."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchrefrac.commands.dense_outputs import draw_dense_outputs, write_dense_outputs, write_depth_maps
from torchrefrac.commands.run_folder import DENSE, RunFolder, read_record
from torchrefrac.commands.survey_products import require_place, require_surface, write_survey_products
from torchrefrac.config import DenseOutputs, DensifyOptions, OptionError
from torchrefrac.dense import DenseError, DenseOptions, FolderStore, densify
from torchrefrac.dense.images import photographs
from torchrefrac.dense.rasterize import raster_of
from torchrefrac.dense.store import CountingStore
from torchrefrac.evaluate.dense_metrics import evaluate_dense_run
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.evaluate.textured import points_to_be_found
from torchrefrac.files.capture import load_capture
from torchrefrac.files.run import DEPTH_MAPS, PARTS
from torchrefrac.files.swap import home, remove_if_empty
from torchrefrac.files.tracks import CAMERAS, read_run
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Similarity
from torchrefrac.parallel import Workers
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, CaptureError, Scene, SceneError, Truth
from torchrefrac.scene.wording import wording_of

MANY_VIEWS = 40
"""Views, from which on there are such as have nothing in common, which can be done at a time."""


class SparseRun(NamedTuple):
    """A run folder with its sparse model, which has the photographs of its views."""

    folder: Path
    scene: Scene


def densify_run(run: SparseRun, options: DensifyOptions, recorder: Recorder) -> dict[str, Any]:
    """Make a run dense and leave the results in its folder, beside those of its other stages. Returns the metrics.

    Dense results that lie there are removed first; `results_in` is for those that should stay until there are new ones.
    What a dense stage that was interrupted has finished is gone on with, where options, photographs and cameras are
    still the same.
    """
    require_place(options.outputs, run.scene.georeference)
    if options.outputs.for_surveys:
        require_surface(run.scene.interfaces)
    files = RunFolder(run.folder)
    with Workers(options.executor) as workers, files.recording_dense():
        truth = load_truth(photographs(run.scene).folder)
        alignment = None if truth is None else evaluate(run.scene, truth)[1]
        dense_stage(files, run.scene, options.dense, options.outputs, truth, alignment, recorder, workers)
    return files.metrics


def dense_stage(
    files: RunFolder,
    scene: Scene,
    options: DenseOptions,
    outputs: DenseOutputs,
    truth: Truth | None,
    alignment: Similarity | None,
    recorder: Recorder,
    workers: Workers | None = None,
) -> None:
    """Densify, evaluate where `alignment` maps the cameras to those of the truth, write and draw everything.

    workers: who does the views of many photographs, by default this process. Every view's patches stay in the folder of
    the run itself until all is written. Raises DenseError where nothing is found or outputs.raster_cell is too small
    for the extent, and what `densify` raises.
    """
    folder = files.folder
    files.save_metrics()
    parts = FolderStore(home(folder) / PARTS, scene, options)
    store, start = CountingStore(parts), time.perf_counter()
    many = scene.views.num_registered >= MANY_VIEWS
    dense = (workers or Workers()).together(partial(densify, scene, options, recorder, store), many)
    seconds = time.perf_counter() - start
    if not len(dense.cloud):
        raise DenseError(
            "no patch of the surface looks the same in several images; it must have texture, and the photographs must "
            "be sharp"
        )
    files.metrics |= {"dense_method": options.method} | store.metrics(seconds)
    raster = raster_of(dense.cloud, outputs.raster_cell) if outputs.needs_raster else None
    seen = None if truth is None or alignment is None else points_to_be_found(truth, scene)
    with recorder.meter(3, "evaluating and writing", "") as advance:
        files.metrics |= evaluate_dense_run(dense.cloud, truth, alignment, seen)
        advance(1, "")
        write_dense_outputs(dense.cloud, raster, outputs, folder)
        advance(1, "")
        shown = raster if outputs.raster else None
        draw_dense_outputs(dense.cloud, shown, scene, truth, alignment, files.metrics, folder)
        advance(1, "")
    if outputs.for_surveys:
        files.metrics |= write_survey_products(dense.cloud, scene, outputs, folder, recorder)
    if outputs.depth_maps:
        write_depth_maps(dense, scene, options, wording_of(scene, files.metrics), recorder, folder / DEPTH_MAPS)
    files.stage_done(DENSE, dense, seconds)
    parts.clear()
    remove_if_empty(parts.folder.parent, home(folder))
    recorder.cloud(DENSE, dense.cloud.points, dense.cloud.colors, 0)


def open_run(folder: Path, given: str | None = None) -> SparseRun:
    """Read the sparse model of a run, and its photographs from where metrics.json says, or from the folder `given`.

    Changes nothing. Raises OptionError, SceneError or CaptureError, with what is missing, where one of them is not
    there or they do not belong together.
    """
    if not folder.is_dir():
        raise OptionError(f"run is {folder}, which is no folder; name one that a run has left behind")
    if not (folder / CAMERAS).is_file():
        raise SceneError(
            f"{folder} holds no {CAMERAS}, so there is no sparse model to begin with: run `torchrefrac` first"
        )
    scene = read_run(folder)
    capture = load_capture(_capture_folder(folder, given))
    row = {name: i for i, name in enumerate(capture.names)}
    views = list(zip(scene.views.names, scene.views.registered.tolist(), strict=True))
    lost = [name for name, registered in views if registered and name not in row]
    if lost:
        raise CaptureError(
            f"{capture.folder / 'capture.json'} does not list {', '.join(lost)}, whose pose is in "
            f"{folder / CAMERAS}; take both from the same photographs"
        )
    scene = scene.of_views(torch.tensor([name in row for name, _ in views]))
    capture = capture.of_views([row[name] for name in scene.views.names])
    _require_same_sizes(capture, scene, folder)
    return SparseRun(folder, replace(scene, capture=capture))


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


def _require_same_sizes(capture: Capture, scene: Scene, folder: Path) -> None:
    here, there = capture.cameras.sizes, scene.cameras.sizes
    for row, before in zip(capture.camera.tolist(), scene.views.camera.tolist(), strict=True):
        if here[row] != there[before]:
            found, wanted = (f"{width}x{height}" for width, height in (here[row], there[before]))
            raise CaptureError(
                f"the photographs in {capture.folder} are {found}, but those of {folder} were {wanted}; give those"
            )
