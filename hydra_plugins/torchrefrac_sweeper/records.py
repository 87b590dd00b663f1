"""What is kept of a job that failed where its run could not do so."""

import os
import traceback
from collections.abc import Iterable
from pathlib import Path

from hydra_plugins.torchrefrac_sweeper.jobs import METRICS, spread


def write_failure(folder: Path, reason: str, model: str, scene: str, overrides: Iterable[str]) -> None:
    """metrics.json of a job that failed before its run began, or beside it.

    Raises OSError where the folder does not take it.
    """
    from torchrefrac.commands.run_folder import write_metrics  # noqa: PLC0415 - Hydra loads this module for everyone

    record = {"status": "failed", "stages": [], "model": model, "scene": scene, "overrides": spread(overrides)}
    write_metrics(record | {"reason": reason}, folder)


def has_ended(folder: Path) -> bool:
    """Whether metrics.json is there, which is written last."""
    return (folder / METRICS).is_file()


def append_traceback(error: BaseException, folder: Path) -> None:
    """Keep in run.log where an error came from. Raises OSError where the folder does not take it."""
    with (folder / "run.log").open("a", encoding="utf-8") as log:
        log.write("".join(traceback.format_exception(error)))


def share_processors() -> None:
    """Take no more threads than the job was given in OMP_NUM_THREADS, also in what does not read it."""
    import cv2  # noqa: PLC0415
    import torch  # noqa: PLC0415

    given = os.environ.get("OMP_NUM_THREADS", "")
    if given.isdigit() and int(given) > 0:
        torch.set_num_threads(int(given))
    cv2.setNumThreads(torch.get_num_threads())
