"""Failures that a run could not record itself, and folders that cannot be used; imports nothing slow."""

import errno
import traceback
from collections.abc import Iterable
from pathlib import Path

from torchrefrac.files.run import RunRecord
from torchrefrac.sweeps.jobs import by_name

FULL = (errno.ENOSPC, errno.EDQUOT)
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


def write_failure(folder: Path, reason: str, model: str, scene: str, overrides: Iterable[str]) -> None:
    """metrics.json of a job that failed before its run began, or beside it.

    Raises OSError where the folder does not take it.
    """
    about = {"status": "failed", "stages": [], "model": model, "scene": scene, "overrides": by_name(overrides)}
    RunRecord.of(folder, about | {"reason": reason}).write()


def append_traceback(error: BaseException, folder: Path) -> None:
    """Keep in run.log where an error came from. Raises OSError where the folder does not take it."""
    with (folder / "run.log").open("a", encoding="utf-8") as log:
        log.write("".join(traceback.format_exception(error)))


def file_sentence(error: OSError, folder: Path | None) -> str:
    """Which file or disk cannot be used, and what to do; `folder` is where results go, for errors without a file."""
    place = error.filename2 or error.filename or folder
    if error.errno in FULL:
        disk = "the disk" if place is None else f"the disk that holds {folder or Path(str(place)).parent}"
        return f"{disk} is full; make room there, or give a folder elsewhere as out=DIR"
    problem = error.strerror or type(error).__name__
    if place is None:
        return problem
    remedy = "; where results should go there, give another folder as out=DIR" if error.errno in FORBIDDEN else ""
    return f"{place} cannot be used ({problem}){remedy}"


def unusable(folder: Path, error: OSError) -> str:
    """The sentence for a folder that results cannot go to."""
    problem = error.strerror or type(error).__name__
    return f"{folder} cannot be written to ({problem}); make it a folder that can, or give another as out=DIR"
