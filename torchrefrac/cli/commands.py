"""The commands: reconstruct a scene, adjust an alignment, make a run dense."""

import os
import shlex
import sys
from collections.abc import Generator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torchrefrac.cli.arguments import typed
from torchrefrac.cli.composed import adjust_options, densify_options, run_options
from torchrefrac.cli.conf import CONF
from torchrefrac.cli.failures import EXPECTED, keep_failure, may_hold_failure, record_text, tell
from torchrefrac.commands.adjust import adjust_run, require_apart
from torchrefrac.commands.densify import SparseRun, densify_run, open_run
from torchrefrac.commands.frames import SUMMARY, densify_frames, frame_lines
from torchrefrac.commands.memory import memory_lack_explained
from torchrefrac.commands.reconstruct import run
from torchrefrac.commands.results import OPTIONS, require_not_replaced, require_outside, results_in
from torchrefrac.config import AdjustOptions, DensifyOptions, FolderOptions, OptionError, RunOptions, scene_folder
from torchrefrac.dense import DenseError
from torchrefrac.files.capture import load_capture
from torchrefrac.files.run import RunRecord, is_number
from torchrefrac.files.swap import home
from torchrefrac.files.truth import load_truth
from torchrefrac.html import write_report
from torchrefrac.record.recorders import RunRecorders, run_recorders
from torchrefrac.record.summary import adjustment_lines, dense_lines, reconstruction_lines, summary, survey_lines
from torchrefrac.record.terminal import TerminalRecorder
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Capture
from torchrefrac.sweeps.jobs import by_name

ONE_BY_ONE = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def reconstruct(config: DictConfig) -> float | None:
    """`torchrefrac`: one run, or one job of a sweep, which raises what goes wrong (see `CompareRuns`). Returns what a
    sweeper that optimises makes small."""
    settings = HydraConfig.get()
    folder = Path(settings.runtime.output_dir)
    if settings.mode is RunMode.MULTIRUN:
        return reconstruct_into(folder, run_options(config), settings, config)
    before = record_text(folder)
    try:
        return reconstruct_into(folder, run_options(config), settings, config)
    except EXPECTED as error:
        keep_failure(error, config, list(settings.overrides.task), folder, before)
        tell(error, folder)
        _report_failure(config, folder, before)
    return None


def is_watched(settings: Any) -> bool:
    """Whether a person sees what a run with these settings of Hydra prints, and no other prints at the same time."""
    return settings.mode is RunMode.RUN or str(settings.launcher["_target_"]) == ONE_BY_ONE


def reconstruct_into(folder: Path, options: RunOptions, settings: Any, config: DictConfig) -> float | None:
    """One run, reported on the terminal where it is watched; `folder` holds its results, or is as it was. Returns its
    objective."""
    if isinstance(options.scene, FolderOptions):
        require_outside(folder, scene_folder(options.scene, None, SilentRecorder()))
    require_not_replaced(folder, "survey", options.reconstruction.survey)
    with memory_lack_explained(), results_in(folder, with_model=options.reconstruction.colmap) as place:
        told = {"config": config, "hydra": {"hydra": settings}, "overrides": settings.overrides.task}
        for name, content in told.items():
            _save(content, place / OPTIONS / f"{name}.yaml", resolve=False)
        metrics = _reconstruct(place, options, settings)
        if settings.mode is RunMode.RUN:
            _report(place, options.output.report)
    return objective(metrics, options.output.objective)


def objective(metrics: Mapping[str, Any], name: str | None) -> float | None:
    """The metric of this name; by default the error of the cameras against the truth, or where that is not known that
    of reprojection. Raises OptionError where the run has no such number."""
    numbers = {key: float(value) for key, value in metrics.items() if is_number(value)}
    if name is not None and name not in numbers:
        raise OptionError(f"objective is {name!r}, but must be a number that metrics.json has: {', '.join(numbers)}")
    default = next((key for key in numbers if key.startswith("camera_rms_")), "reprojection_median_px")
    return numbers.get(name or default)


def _reconstruct(place: Path, options: RunOptions, settings: Any) -> Mapping[str, Any]:
    quiet = options.output.quiet or not is_watched(settings)
    overrides = by_name(settings.overrides.task)
    with _recorders(place, quiet) as recorder:
        capture = load_capture(scene_folder(options.scene, options.output.cache, recorder))
        model = options.reconstruction.model.name
        if not quiet:
            into = os.path.relpath(home(place))
            print(f"{options.scene.label}: {len(capture)} images, model {model}, into {into}", file=sys.stderr)
        about = {"scene": options.scene.label, "overrides": overrides}
        metrics = run(capture, options.reconstruction, recorder, place, about, load_truth(capture.folder))
        recorder.hparams(_compared(options, capture, overrides), metrics)
    if not quiet:
        print(summary(reconstruction_lines(metrics)))
    return metrics


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="adjust")
def adjust(config: DictConfig) -> None:
    """`torchrefrac adjust`."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    before = record_text(folder)
    try:
        options = adjust_options(config)
        require_apart(options, folder)
        with memory_lack_explained(), results_in(folder, with_model=True) as place:
            _adjust(options, config, place)
            _report(place, options.report)
    except EXPECTED as error:
        failure = {"status": "failed", "stages": [], "command": "adjust", "reason": tell(error, folder)}
        if record_text(folder) == before and may_hold_failure(error, config, folder):
            RunRecord.of(folder, failure).write()
        _report_failure(config, folder, before)


def _adjust(options: AdjustOptions, config: DictConfig, place: Path) -> None:
    if not options.quiet:
        print(f"{options.alignment}: adjusting again, into {os.path.relpath(home(place))}", file=sys.stderr)
    _save(config, place / OPTIONS / "config.yaml")
    with _recorders(place, options.quiet) as recorder:
        metrics = adjust_run(options, recorder, place)
    if not options.quiet:
        print(summary(adjustment_lines(metrics)))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="densify")
def densify(config: DictConfig) -> None:
    """`torchrefrac densify`."""
    with may_fail(), memory_lack_explained():
        options = densify_options(config)
        if options.frames is not None:
            rows = densify_frames(options, SilentRecorder() if options.quiet else TerminalRecorder())
            if not options.quiet:
                print(summary(frame_lines(rows)))
            if any(row["status"] != "complete" for row in rows):
                raise DenseError(f"some frames are not dense; {os.path.join(options.out or '', SUMMARY)} says why")
            return
        sparse = open_run(Path(options.run), options.capture)
        before = record_text(sparse.folder)
        try:
            with results_in(sparse.folder, goes_on=True) as place:
                _densify(sparse._replace(folder=place), options, config)
                _report(place, options.report)
        except EXPECTED as error:
            tell(error, sparse.folder)
            _report_failure(config, sparse.folder, before)


def _densify(sparse: SparseRun, options: DensifyOptions, config: DictConfig) -> None:
    posed = sparse.scene.views.num_registered
    if not options.quiet:
        print(f"{options.run}: making {posed} images dense, method {options.dense.method}", file=sys.stderr)
    _save(config, sparse.folder / OPTIONS / "densify.yaml")
    with _recorders(sparse.folder, options.quiet, append=True) as recorder:
        metrics = densify_run(sparse, options, recorder)
    if not options.quiet:
        print(summary(dense_lines(metrics) + survey_lines(metrics)))


def _report(folder: Path, wanted: bool) -> None:
    """Write report.html where it is wanted."""
    if wanted:
        with may_fail(folder):
            write_report(folder)


def _report_failure(config: DictConfig, folder: Path, before: bytes | None) -> None:
    """The same of a run that failed, unless it has left no word of itself."""
    if record_text(folder) != before:
        _report(folder, bool(config.get("report")))


def _recorders(folder: Path, quiet: bool, append: bool = False) -> AbstractContextManager[RunRecorders]:
    about = {"command": shlex.join(["torchrefrac", *(typed or sys.argv[1:])])}
    return run_recorders(folder, quiet, about=about, expected=EXPECTED, append=append)


@contextmanager
def may_fail(folder: Path | None = None) -> Generator[None, None, None]:
    """Errors for the user are printed, and make the exit status 1."""
    try:
        yield
    except EXPECTED as error:
        tell(error, folder)


def _compared(options: RunOptions, capture: Capture, overrides: dict[str, str]) -> dict[str, Any]:
    """What TensorBoard's table of runs compares: the same of all runs, and the overrides of this one."""
    chosen = options.reconstruction
    refracts = chosen.model.name == "refractive"
    common = {
        "scene": options.scene.label,
        "model": chosen.model.name,
        "water.index_ratio": chosen.water.ratio_of(capture.index_ratio) if refracts else 1.0,
        "dense": chosen.dense.method,
        "seed": chosen.seed,
    }
    return common | {name: _number(value) for name, value in overrides.items() if name not in common}


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _save(content: Any, path: Path, resolve: bool = True) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.create(content) if isinstance(content, dict) else content, path, resolve=resolve)
