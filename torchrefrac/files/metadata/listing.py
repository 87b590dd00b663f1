"""Which files are meant by a folder, a pattern or a file: those of a memory card, in the order of their names."""

import glob
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from torchrefrac.files.metadata.kinds import FILMS, HEIC, PICTURES, RAW, unreadable
from torchrefrac.scene.capture import CaptureError

MOST_FILES = 100_000
IMAGES = "images"  # folder of the frames that were taken from a film, among results


class Listing(NamedTuple):
    """Pictures, absolute paths; others: what is no picture that is read here, and why. films beside them."""

    pictures: list[Path]
    others: dict[Path, str]
    films: list[Path]


def list_photographs(sources: Sequence[str], apart: Path) -> Listing:
    """The files of folders and what lies in them, of patterns, and single files, each once; hidden ones, and frames
    among the results in `apart`, are not looked at. Raises CaptureError where nothing is there."""
    files: dict[Path, None] = {}
    for source in sources:
        found = list(_files(source, apart))
        if not found:
            raise CaptureError(f"photos is {source}, where no file is; name the folder with the photographs")
        files |= dict.fromkeys(found)
    paths = sorted(files, key=_natural)
    pictures = [path for path in paths if path.suffix.lower() in PICTURES]
    stems = {str(path.with_suffix("")).lower() for path in pictures}
    others = {path: unreadable(path, stems) for path in paths if path.suffix.lower() in (*RAW, *HEIC)}
    return Listing(pictures, others, [path for path in paths if path.suffix.lower() in FILMS])


def common_folder(paths: Iterable[Path]) -> Path:
    """The innermost folder that all files lie in."""
    return Path(os.path.commonpath([path.parent for path in paths]))


def _files(source: str, apart: Path) -> Iterator[Path]:
    given = Path(os.path.abspath(os.path.expanduser(source)))
    results = apart / IMAGES
    roots = [given] if given.exists() else [Path(path) for path in sorted(glob.glob(str(given), recursive=True))]
    for root in roots:
        if root.is_file():
            yield root
        for folder, inner, names in os.walk(root):
            inner[:] = sorted(name for name in inner if not name.startswith(".") and Path(folder, name) != results)
            paths = [Path(folder, name) for name in sorted(names) if not name.startswith(".")]
            if len(paths) > MOST_FILES:
                raise CaptureError(f"{folder} holds {len(paths)} files, more than a capture may have; name fewer")
            yield from (path for path in paths if path.is_file())


def _natural(path: Path) -> list[tuple[int, str]]:
    """IMG_2 before IMG_10."""
    parts = re.split(r"(\d+)", str(path).lower())
    return [(int(part), "") if part.isdigit() and len(part) < 18 else (0, part) for part in parts]
