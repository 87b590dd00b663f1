"""The command line: Hydra composes the options, this module hands them to the pipeline."""

import os
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from torchrefrac.bundle import UnadjustableError
from torchrefrac.config import AdjustOptions, OptionError, Options, RunOptions, SceneOptions, build
from torchrefrac.pipeline import ReconstructionError, run
from torchrefrac.readjustment import readjust_run, require_apart
from torchrefrac.report.comparison import compare
from torchrefrac.report.recorders import Recorders
from torchrefrac.report.run_folder import write_metrics
from torchrefrac.report.tensorboard import TensorBoardRecorder
from torchrefrac.report.terminal import WIDTH, TerminalRecorder
from torchrefrac.scene import AlignmentError, Capture, CaptureError, SurveyError, load_capture
from torchrefrac.scene.library import embedded_scene
from torchrefrac.sfm import NoInitialPairError

PACKAGED = Path(__file__).resolve().parent / "conf"
CONF = PACKAGED if PACKAGED.is_dir() else PACKAGED.parent.parent / "conf"
EXPECTED = (
    AlignmentError,
    CaptureError,
    MissingMandatoryValue,
    NoInitialPairError,
    OptionError,
    OSError,
    ReconstructionError,
    SurveyError,
    UnadjustableError,
)
INTERRUPTED = 130
ADJUST = "adjust"
LEFT_OUT = {
    "lost_images": "images left out, as too few of their points fit",
    "lost_marks": "marks left out, as they do not fit or are not seen",
    "images_only_in_survey": "images of the survey that the alignment does not have",
}

_failed: list[str] = []


def main() -> None:
    """Run the command that is in sys.argv; exits with 1 where a job failed, 130 where it was interrupted."""
    _failed.clear()
    command: Callable[[], None] = _hydra_main
    if sys.argv[1:2] == [ADJUST]:
        sys.argv = [sys.argv[0], *sys.argv[2:]]  # what is left is Hydra's
        command = _hydra_adjust
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
    return RunOptions(build(SceneOptions, scene, "scene"), build(Options, values), out)


def adjust_options(config: DictConfig) -> AdjustOptions:
    """The typed options of a composed configuration of `torchrefrac adjust`."""
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return build(AdjustOptions, values)


def scene_folder(scene: SceneOptions) -> Path:
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
    print(_summary(metrics))


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
    (folder / ".hydra").mkdir(parents=True, exist_ok=True)
    OmegaConf.save(config, folder / ".hydra" / "config.yaml", resolve=True)
    with TensorBoardRecorder(folder / "events") as board:
        metrics = readjust_run(options, Recorders(TerminalRecorder(), board), folder)
    for line in _adjust_summary(metrics):
        print(textwrap.fill(line, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False))


def _report(error: Exception) -> str:
    """Tell the user, remember the failure for the exit status; returns the sentence."""
    if isinstance(error, MissingMandatoryValue):
        reason = f"{error.full_key} is missing; give it on the command line as {error.full_key}=VALUE"
    else:
        reason = " ".join(str(error).split())
    _failed.append(reason)
    print(f"error: {reason}", file=sys.stderr)
    return reason


def _adjust_summary(metrics: dict[str, Any]) -> list[str]:
    unit, sigma = metrics["length_unit"], metrics["index_ratio_sigma"]
    spread = "" if sigma is None else f" +- {sigma:.2g}"
    lines = [
        f"{metrics['adjusted_images']} of {metrics['images']} images adjusted, {metrics['points']} points "
        f"({metrics['dropped_points']} dropped), {metrics['observations']} observations "
        f"({metrics['dropped_observations']} dropped)",
        f"median reprojection error {metrics['reprojection_median_px']:.3f} px, through the water before "
        f"{metrics['reprojection_median_before_px']:.3f} px, {metrics['seconds_total']:.1f} s",
        f"index ratio {metrics['index_ratio']:.4f}{spread}, cameras moved by "
        f"{metrics[f'camera_shift_median_{unit}']:.4g} {unit} (median), "
        f"{metrics[f'camera_shift_max_{unit}']:.4g} {unit} at most",
        *metrics["determined"],
    ]
    lines += [f"not refined: {sentence}" for sentence in metrics["held"].values()]
    for key, words in LEFT_OUT.items():
        if key in metrics:
            lines.append(f"{words}: {', '.join(metrics[key])}")
    if metrics["adjustment"] != "converged":
        lines.append(f"the adjustment ended as {metrics['adjustment']}; see bundle.solver for its limits")
    return lines + _against_truth(metrics)


def _against_truth(metrics: dict[str, Any]) -> list[str]:
    key = next((key for key in metrics if key.startswith("camera_rms_")), None)
    if key is None:
        return []
    unit = key.removeprefix("camera_rms_")
    line = f"against truth ({metrics['alignment']} alignment): cameras {metrics[key]:.4f} {unit} RMS"
    if f"surface_median_{unit}" in metrics:
        line += f", points {metrics[f'surface_median_{unit}']:.4f} {unit} from the surface (median)"
    return [line]


def _summary(metrics: dict[str, Any]) -> str:
    lines = [
        f"{metrics['registered_images']} of {metrics['images']} images registered, {metrics['points']} points, "
        f"median reprojection error {metrics['reprojection_median_px']:.3f} px, {metrics['seconds_total']:.1f} s"
    ]
    lines += [f"not registered: {name} {reason}" for name, reason in metrics.get("not_registered", {}).items()]
    if metrics["gravity"] == "estimated":
        lines.append(
            "gravity was estimated from the refraction; the verticals are determined to "
            f"{metrics['gravity_sigma_deg']:.1f} degrees"
        )
    return "\n".join(lines + _against_truth(metrics))


class CompareRuns(Callback):
    """After a multirun, whatever it ran over: the paper's Table 1 and Figure 1."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        runs = sorted((path.parent for path in folder.glob("*/metrics.json")), key=_job_order)
        if not runs:
            return
        print(compare(runs, folder))
        print(f"the table and its figure are in {os.path.relpath(folder)}")


def _job_order(run: Path) -> tuple[int, str]:
    """Folders are named JOB_MODEL; others come last."""
    job = run.name.split("_")[0]
    return (int(job) if job.isdigit() else sys.maxsize), run.name
