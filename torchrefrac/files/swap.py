"""Results that take the place of earlier ones as a whole; imports nothing that is slow.

New results are made in a folder inside that of the run. Renaming it says that they are complete; then each file is
moved to its place. Where that breaks off, whoever looks at the folder next goes on with it: all new ones are there.
"""

import json
import os
import shutil
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from torchrefrac.errors import TorchrefracError

PARTIAL, READY = ".torchrefrac-partial", ".torchrefrac-ready"  # new results that are being made, and complete ones
LOCK, LEFT_OUT = ".torchrefrac-lock", "left_out.json"


class FolderInUseError(TorchrefracError, ValueError):
    """Another process works in a folder; the message names it."""


def home(folder: Path) -> Path:
    """The folder of the run whose new results are made in `folder`."""
    return folder.parent if folder.name == PARTIAL else folder


@contextmanager
def alone(folder: Path) -> Generator[None, None, None]:
    """While no other process works in a folder. Raises FolderInUseError at once where one does."""
    path = folder / LOCK
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        remedy = "wait until it has ended, or name another folder"
        raise FolderInUseError(f"{folder} is in use by another process; {remedy}") from None
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # while it is still locked, so that nobody holds a file that is gone
        lock.release()


def swap(place: Path, earlier: Iterable[str]) -> None:
    """Let the files in `place`, which is PARTIAL in the folder of a run, take the place of `earlier` ones of that
    folder, which have names relative to it."""
    left_out = sorted(name for name in set(earlier) if not (place / name).is_file())
    (place / LEFT_OUT).write_text(json.dumps(left_out), encoding="utf-8")
    place.rename(home(place) / READY)
    finish(home(place))


def finish(folder: Path) -> None:
    """Go on with a swap that broke off, where there is one; for whoever works in the folder alone."""
    ready = folder / READY
    listed = ready / LEFT_OUT
    if listed.is_file():
        for name in json.loads(listed.read_text(encoding="utf-8")):
            (folder / name).unlink(missing_ok=True)
            remove_if_empty((folder / name).parent, folder)
        for path in sorted(path for path in ready.rglob("*") if path.is_file() and path != listed):
            target = folder / path.relative_to(ready)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
        listed.unlink()
    if ready.is_dir():
        shutil.rmtree(ready)


def settle(folder: Path) -> None:
    """The same for whoever only reads; a process that works there, or may not be disturbed, does it itself."""
    if (folder / READY).is_dir():
        with suppress(FolderInUseError, PermissionError), alone(folder):
            finish(folder)


def remove_if_empty(folder: Path, root: Path) -> None:
    """Remove a folder in which nothing lies, and those around it, as far as they lie inside `root`."""
    while root in folder.parents and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
