"""The command line: Hydra composes the options, this module hands them to the pipeline."""

import os
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from torchrefrac.config import OptionError, Options, RunOptions, SceneOptions, build
from torchrefrac.pipeline import ReconstructionError, run
from torchrefrac.report.comparison import compare
from torchrefrac.report.recorders import Recorders
from torchrefrac.report.run_folder import write_metrics
from torchrefrac.report.tensorboard import TensorBoardRecorder
from torchrefrac.report.terminal import TerminalRecorder
from torchrefrac.scene import CaptureError, load_capture
from torchrefrac.scene.library import embedded_scene
from torchrefrac.sfm import NoInitialPairError

PACKAGED = Path(__file__).resolve().parent / "conf"
CONF = PACKAGED if PACKAGED.is_dir() else PACKAGED.parent.parent / "conf"
EXPECTED = (CaptureError, OptionError, ReconstructionError, NoInitialPairError, MissingMandatoryValue, OSError)
INTERRUPTED = 130

_failed: list[str] = []


def main() -> None:
    """Run the command that is in sys.argv; exits with 1 where a job failed, 130 where it was interrupted."""
    _failed.clear()
    try:
        _hydra_main()
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


def scene_folder(scene: SceneOptions) -> Path:
    """Where the capture of a scene lies."""
    return embedded_scene(scene.name) if scene.path is None else Path(scene.path)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _hydra_main(config: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        _run(config, folder)
    except EXPECTED as error:
        reason = _sentence(error)
        _failed.append(reason)
        if not (folder / "metrics.json").is_file():
            write_metrics({"status": "failed", "stages": [], "model": config.model.name, "reason": reason}, folder)
        print(f"error: {reason}", file=sys.stderr)


def _run(config: DictConfig, folder: Path) -> None:
    options = run_options(config)
    capture = load_capture(scene_folder(options.scene))
    model = options.reconstruction.model.name
    into = os.path.relpath(folder)
    print(f"{options.scene.name}: {len(capture)} images, model {model}, into {into}", file=sys.stderr)
    with TensorBoardRecorder(folder / "events") as board:
        metrics = run(capture, options.reconstruction, Recorders(TerminalRecorder(), board), folder)
    print(_summary(metrics, capture.length_unit))


def _summary(metrics: dict[str, Any], unit: str) -> str:
    lines = [
        f"{metrics['registered_images']} of {metrics['images']} images registered, {metrics['points']} points, "
        f"median reprojection error {metrics['reprojection_median_px']:.3f} px, {metrics['seconds_total']:.1f} s"
    ]
    lines += [f"not registered: {name} {reason}" for name, reason in metrics.get("not_registered", {}).items()]
    if f"camera_rms_{unit}" in metrics:
        line = (
            f"against truth ({metrics['alignment']} alignment): cameras {metrics[f'camera_rms_{unit}']:.4f} {unit} RMS"
        )
        if f"surface_median_{unit}" in metrics:
            line += f", points {metrics[f'surface_median_{unit}']:.4f} {unit} from the surface (median)"
        lines.append(line)
    return "\n".join(lines)


def _sentence(error: Exception) -> str:
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} is missing; give it on the command line as {error.full_key}=VALUE"
    return " ".join(str(error).split())


class CompareRuns(Callback):
    """After a multirun, whatever it ran over: the paper's Table 1 and Figure 1."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        runs = sorted((p.parent for p in folder.glob("*/metrics.json")), key=lambda p: int(p.name.split("_")[0]))
        if not runs:
            return
        print(compare(runs, folder))
        print(f"the table and its figure are in {os.path.relpath(folder)}")
