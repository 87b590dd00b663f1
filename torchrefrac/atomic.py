"""Files that appear whole or not at all."""

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Generator[Path, None, None]:
    """A temporary name beside `path`, with the same ending; renamed to `path` if the block succeeds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_unfinished(folder: Path, pattern: str = "") -> None:
    """Remove what `replacing` leaves in a folder, and with the pattern "**/" in those inside, where a process is killed
    while it writes; for whoever works there alone."""
    for path in folder.glob(f"{pattern}.*.partial.*"):
        path.unlink(missing_ok=True)


@contextmanager
def passing(path: Path) -> Generator[Path, None, None]:
    """The name of a file that is needed within the block alone."""
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)
