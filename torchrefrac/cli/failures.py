"""Errors are one sentence on the terminal, and in the folder of the run."""

import os
import sys
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from hydra_plugins.torchrefrac_sweeper.messages import one_sentence
from torchrefrac.bundle import UnadjustableError
from torchrefrac.commands.reconstruct import ReconstructionError
from torchrefrac.config import OptionError
from torchrefrac.dense import DenseError
from torchrefrac.files.run import METRICS, RunRecordError
from torchrefrac.scene import CaptureError, SceneError, SurveyError
from torchrefrac.sfm import NoInitialPairError
from torchrefrac.sweeps.folder import SweepError, append_traceback, write_failure

EXPECTED = (
    CaptureError, DenseError, MissingMandatoryValue, NoInitialPairError, OptionError, OSError, ReconstructionError,
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


def keep_failure(error: Exception, config: DictConfig, overrides: list[str], folder: Path) -> str:
    """Leave in the folder of a run why it failed, unless the run did so itself, as far as that can be written; returns
    the sentence."""
    reason = one_sentence(error, folder)
    try:
        if not isinstance(error, EXPECTED):
            append_traceback(error, folder)
            reason += f"; {os.path.relpath(folder / 'run.log')} says where"
        if not (folder / METRICS).is_file():
            write_failure(folder, reason, str(config.model.name), _scene(config), overrides)
    except OSError as other:
        print(f"error: {one_sentence(other, folder)}", file=sys.stderr)
    return reason


def _scene(config: DictConfig) -> str:
    path = None if OmegaConf.is_missing(config.scene, "path") else config.scene.get("path")
    return str(config.scene.name) if path is None else Path(str(path)).name
