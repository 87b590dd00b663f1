"""The command line: Hydra composes the options, this module hands them to the pipeline."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from torchrefrac.bundle import UnadjustableError
from torchrefrac.config import (
    AdjustOptions,
    DensifyOptions,
    FolderOptions,
    OptionError,
    Options,
    RunOptions,
    build,
    build_scene,
)
from torchrefrac.dense import DenseError
from torchrefrac.densification import SparseRun, densify_run, open_run
from torchrefrac.pipeline import ReconstructionError, run
from torchrefrac.readjustment import readjust_run, require_apart
from torchrefrac.report.comparison import compare
from torchrefrac.report.recorders import Recorders
from torchrefrac.report.run_folder import write_metrics
from torchrefrac.report.summary import adjustment_lines, dense_lines, reconstruction_lines, summary
from torchrefrac.report.tensorboard import TensorBoardRecorder
from torchrefrac.report.terminal import TerminalRecorder
from torchrefrac.scene import AlignmentError, Capture, CaptureError, SurveyError, load_capture
from torchrefrac.scene.library import embedded_scene
from torchrefrac.sfm import NoInitialPairError

PACKAGED = Path(__file__).resolve().parent / "conf"
CONF = PACKAGED if PACKAGED.is_dir() else PACKAGED.parent.parent / "conf"
EXPECTED = (
    AlignmentError,
    CaptureError,
    DenseError,
    MissingMandatoryValue,
    NoInitialPairError,
    OptionError,
    OSError,
    ReconstructionError,
    SurveyError,
    UnadjustableError,
)
INTERRUPTED = 130
ADJUST, DENSIFY = "adjust", "densify"

_failed: list[str] = []


def main() -> None:
    """Run the command that is in sys.argv; exits with 1 where a job failed, 130 where it was interrupted."""
    _failed.clear()
    others: dict[str, Callable[[], None]] = {ADJUST: _hydra_adjust, DENSIFY: _hydra_densify}
    command = others.get(sys.argv[1]) if len(sys.argv) > 1 else None
    if command is None:
        command = _hydra_main
    else:
        sys.argv = [sys.argv[0], *sys.argv[2:]]  # what is left is Hydra's
    try:
        command()
    except KeyboardInterrupt:
        print("interrupted; the files of the finished stages are in the run folder", file=sys.stderr)
        sys.exit(INTERRUPTED)
    if _failed:
        sys.exit(1)


def run_options(config: DictConfig) -> RunOptions:
    """The typed options of a composed configuration."""
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    scene, out = values.pop("scene"), values.pop("out")
    return RunOptions(build_scene(scene), build(Options, values), out)


def adjust_options(config: DictConfig) -> AdjustOptions:
    """The typed options of a composed configuration of `torchrefrac adjust`."""
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return build(AdjustOptions, values)


def densify_options(config: DictConfig) -> DensifyOptions:
    """The typed options of a composed configuration of `torchrefrac densify`."""
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return build(DensifyOptions, values)


def scene_folder(scene: FolderOptions) -> Path:
    """Where the capture of a scene lies."""
    return embedded_scene(scene.name) if scene.path is None else Path(scene.path)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _hydra_main(config: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        options = run_options(config)
        capture = load_capture(scene_folder(options.scene))
    except EXPECTED as error:
        write_metrics({"status": "failed", "stages": [], "model": config.model.name, "reason": _report(error)}, folder)
        return
    try:
        _run(options, capture, folder)
    except EXPECTED as error:
        _report(error)


def _run(options: RunOptions, capture: Capture, folder: Path) -> None:
    model = options.reconstruction.model.name
    into = os.path.relpath(folder)
    print(f"{options.scene.name}: {len(capture)} images, model {model}, into {into}", file=sys.stderr)
    with TensorBoardRecorder(folder / "events") as board:
        metrics = run(capture, options.reconstruction, Recorders(TerminalRecorder(), board), folder)
    print(summary(reconstruction_lines(metrics)))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="adjust")
def _hydra_adjust(config: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        if not OmegaConf.is_missing(config, "alignment"):
            require_apart(Path(str(config.alignment)), folder)
    except EXPECTED as error:
        _report(error)  # and leave alone what is there
        return
    try:
        options = adjust_options(config)
    except EXPECTED as error:
        write_metrics({"status": "failed", "stages": [], "command": ADJUST, "reason": _report(error)}, folder)
        return
    try:
        _adjust(options, config, folder)
    except EXPECTED as error:
        _report(error)


def _adjust(options: AdjustOptions, config: DictConfig, folder: Path) -> None:
    print(f"{options.alignment}: adjusting anew, into {os.path.relpath(folder)}", file=sys.stderr)
    _save(config, folder / ".hydra" / "config.yaml")
    with TensorBoardRecorder(folder / "events") as board:
        metrics = readjust_run(options, Recorders(TerminalRecorder(), board), folder)
    print(summary(adjustment_lines(metrics)))


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="densify")
def _hydra_densify(config: DictConfig) -> None:
    try:
        options = densify_options(config)
        _densify(open_run(Path(options.run), options.capture), options, config)
    except EXPECTED as error:
        _report(error)


def _densify(run: SparseRun, options: DensifyOptions, config: DictConfig) -> None:
    posed = int(run.reconstruction.registered.sum())
    print(f"{options.run}: making {posed} images dense, method {options.dense.method}", file=sys.stderr)
    _save(config, run.folder / ".hydra" / "densify.yaml")
    with TensorBoardRecorder(run.folder / "events") as board:
        metrics = densify_run(run, options, Recorders(TerminalRecorder(), board))
    print(summary(dense_lines(metrics)))


def _save(config: DictConfig, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(config, path, resolve=True)


def _report(error: Exception) -> str:
    """Tell the user, remember the failure for the exit status; returns the sentence."""
    if isinstance(error, MissingMandatoryValue):
        reason = f"{error.full_key} is missing; give it on the command line as {error.full_key}=VALUE"
    else:
        reason = " ".join(str(error).split())
    _failed.append(reason)
    print(f"error: {reason}", file=sys.stderr)
    return reason


class CompareRuns(Callback):
    """After a multirun, whatever it ran over: the paper's Table 1 and Figure 1, also of dense surfaces."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        runs = sorted((path.parent for path in folder.glob("*/metrics.json")), key=_job_order)
        if not runs:
            return
        print(compare(runs, folder))
        print(f"the table and its figures are in {os.path.relpath(folder)}")


def _job_order(run: Path) -> tuple[int, str]:
    """Folders are named JOB_MODEL; others come last."""
    job = run.name.split("_")[0]
    return (int(job) if job.isdigit() else sys.maxsize), run.name
