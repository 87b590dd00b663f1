"""Errors are one sentence on the terminal, and in the folder of the run."""

import os
import sys
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from hydra_plugins.torchrefrac_sweeper.messages import one_sentence
from torchrefrac.bundle import UnadjustableError
from torchrefrac.commands.correct import CorrectionError
from torchrefrac.commands.memory import MemoryLackError
from torchrefrac.commands.results import OutRefusedError, holds_nothing
from torchrefrac.commands.verification import ReconstructionError
from torchrefrac.config import OptionError
from torchrefrac.dense import DenseError
from torchrefrac.files.clouds import CloudError
from torchrefrac.files.run import METRICS, RunRecordError
from torchrefrac.files.swap import FolderInUseError
from torchrefrac.parallel import ExecutorError
from torchrefrac.scene import CaptureError, SceneError, SurveyError
from torchrefrac.sfm import NoInitialPairError
from torchrefrac.sfm.known_points import CalibrationError
from torchrefrac.sweeps.folder import SweepError, append_traceback, write_failure

EXPECTED = (
    CalibrationError, CaptureError, CloudError, CorrectionError, DenseError, ExecutorError, FolderInUseError,
    MemoryLackError, MissingMandatoryValue, NoInitialPairError, OptionError, OSError, ReconstructionError,
    RunRecordError, SceneError, SurveyError, SweepError, UnadjustableError,
)  # fmt: skip
"""Errors whose message is for the user; all others are bugs, and come with a traceback."""

failed: list[str] = []
"""What failed since the command began; anything here makes its exit status 1."""


def tell(error: Exception, folder: Path | None = None) -> str:
    """Tell the user, remember the failure for the exit status; returns the sentence."""
    reason = one_sentence(error, folder)
    failed.append(reason)
    print(f"error: {reason}", file=sys.stderr)
    return reason


def record_text(folder: Path) -> bytes | None:
    """What metrics.json in a folder holds; None where it cannot be read."""
    try:
        return (folder / METRICS).read_bytes()
    except OSError:
        return None


def keep_failure(
    error: Exception, config: DictConfig, overrides: list[str], folder: Path, before: bytes | None = None
) -> str:
    """Leave in the folder of a run why it failed, as far as that can be written; returns the sentence.

    Not where the run did so itself, so that metrics.json is no longer what it was `before`, nor where the folder holds
    results, which that would be untrue of.
    """
    reason = one_sentence(error, folder)
    try:
        if not isinstance(error, EXPECTED):
            append_traceback(error, folder)
            reason += f"; {os.path.relpath(folder / 'run.log')} says where"
        if record_text(folder) == before and may_hold_failure(error, config, folder):
            write_failure(folder, reason, str(config.model.name), _scene(config), overrides)
    except OSError as other:
        print(f"error: {one_sentence(other, folder)}", file=sys.stderr)
    return reason


def may_hold_failure(error: Exception, config: DictConfig, folder: Path) -> bool:
    """Whether a folder is there for the results of the run that failed, and nothing else lies in it."""
    taken = isinstance(error, OutRefusedError | FolderInUseError) or not str(config.get("out") or "").strip()
    return not taken and holds_nothing(folder)


def _scene(config: DictConfig) -> str:
    path = None if OmegaConf.is_missing(config.scene, "path") else config.scene.get("path")
    return str(config.scene.name) if path is None else Path(str(path)).name
