"""The commands: reconstruct a scene, adjust an alignment, make a run dense."""

import os
import shlex
import sys
from collections.abc import Generator
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
from torchrefrac.cli.failures import EXPECTED, keep_failure, tell
from torchrefrac.commands.adjust import adjust_run, require_apart
from torchrefrac.commands.densify import SparseRun, densify_run, open_run
from torchrefrac.commands.reconstruct import run
from torchrefrac.config import AdjustOptions, DensifyOptions, RunOptions, scene_folder
from torchrefrac.files.capture import load_capture
from torchrefrac.files.run import METRICS, RunRecord
from torchrefrac.files.truth import load_truth
from torchrefrac.html import write_report
from torchrefrac.record.recorders import RunRecorders, run_recorders
from torchrefrac.record.summary import adjustment_lines, dense_lines, reconstruction_lines, summary
from torchrefrac.scene import Capture
from torchrefrac.sweeps.jobs import by_name

ONE_BY_ONE = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def reconstruct(config: DictConfig) -> None:
    """`torchrefrac`: one run, or one job of a sweep, which raises what goes wrong (see `CompareRuns`)."""
    settings = HydraConfig.get()
    folder = Path(settings.runtime.output_dir)
    if settings.mode is RunMode.MULTIRUN:
        reconstruct_into(folder, run_options(config), settings)
        return
    (folder / METRICS).unlink(missing_ok=True)
    try:
        reconstruct_into(folder, run_options(config), settings)
    except EXPECTED as error:
        keep_failure(error, config, list(settings.overrides.task), folder)
        tell(error, folder)
    if config.get("report"):
        with _may_fail(folder):
            write_report(folder)


def is_watched(settings: Any) -> bool:
    """Whether a person sees what a run with these settings of Hydra prints, and no other prints at the same time."""
    return settings.mode is RunMode.RUN or str(settings.launcher["_target_"]) == ONE_BY_ONE


def reconstruct_into(folder: Path, options: RunOptions, settings: Any) -> None:
    """One run, reported on the terminal where it is watched."""
    quiet = options.output.quiet or not is_watched(settings)
    overrides = by_name(settings.overrides.task)
    with _recorders(folder, quiet) as recorder:
        capture = load_capture(scene_folder(options.scene, options.output.cache, recorder))
        model = options.reconstruction.model.name
        if not quiet:
            into = os.path.relpath(folder)
            print(f"{options.scene.label}: {len(capture)} images, model {model}, into {into}", file=sys.stderr)
        about = {"scene": options.scene.label, "overrides": overrides}
        metrics = run(capture, options.reconstruction, recorder, folder, about, load_truth(capture.folder))
        recorder.hparams(_compared(options, capture, overrides), metrics)
    if not quiet:
        print(summary(reconstruction_lines(metrics)))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="adjust")
def adjust(config: DictConfig) -> None:
    """`torchrefrac adjust`."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        if not OmegaConf.is_missing(config, "alignment"):
            require_apart(Path(str(config.alignment)), folder)
    except EXPECTED as error:
        tell(error)  # and leave alone what is there
        return
    try:
        options = adjust_options(config)
    except EXPECTED as error:
        failure = {"status": "failed", "stages": [], "command": "adjust", "reason": tell(error)}
        RunRecord.of(folder, failure).write()
    else:
        with _may_fail(folder):
            _adjust(options, config, folder)
    if config.report:
        with _may_fail(folder):
            write_report(folder)


def _adjust(options: AdjustOptions, config: DictConfig, folder: Path) -> None:
    if not options.quiet:
        print(f"{options.alignment}: adjusting again, into {os.path.relpath(folder)}", file=sys.stderr)
    _save(config, folder / ".hydra" / "config.yaml")
    with _recorders(folder, options.quiet) as recorder:
        metrics = adjust_run(options, recorder, folder)
    if not options.quiet:
        print(summary(adjustment_lines(metrics)))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="densify")
def densify(config: DictConfig) -> None:
    """`torchrefrac densify`."""
    with _may_fail():
        options = densify_options(config)
        sparse = open_run(Path(options.run), options.capture)
        with _may_fail(sparse.folder):
            _densify(sparse, options, config)
        if options.report:
            write_report(sparse.folder)


def _densify(sparse: SparseRun, options: DensifyOptions, config: DictConfig) -> None:
    posed = sparse.scene.views.num_registered
    if not options.quiet:
        print(f"{options.run}: making {posed} images dense, method {options.dense.method}", file=sys.stderr)
    _save(config, sparse.folder / ".hydra" / "densify.yaml")
    with _recorders(sparse.folder, options.quiet, append=True) as recorder:
        metrics = densify_run(sparse, options, recorder)
    if not options.quiet:
        print(summary(dense_lines(metrics)))


def _recorders(folder: Path, quiet: bool, append: bool = False) -> AbstractContextManager[RunRecorders]:
    about = {"command": shlex.join(["torchrefrac", *(typed or sys.argv[1:])])}
    return run_recorders(folder, quiet, about=about, expected=EXPECTED, append=append)


@contextmanager
def _may_fail(folder: Path | None = None) -> Generator[None, None, None]:
    """Errors for the user are printed, and make the exit status 1."""
    try:
        yield
    except EXPECTED as error:
        tell(error, folder)


def _compared(options: RunOptions, capture: Capture, overrides: dict[str, str]) -> dict[str, Any]:
    """What TensorBoard's table of runs compares: the same of all runs, and the overrides of this one."""
    chosen = options.reconstruction
    common = {
        "scene": options.scene.label,
        "model": chosen.model.name,
        "water.index_ratio": chosen.water.ratio_of(capture.index_ratio),
        "dense": chosen.dense.method,
        "seed": chosen.seed,
    }
    return common | {name: _number(value) for name, value in overrides.items() if name not in common}


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _save(config: DictConfig, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(config, path, resolve=True)
