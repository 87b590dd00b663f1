"""NumPy archives that say what they are, written whole and read with every array checked."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchrefrac.atomic import replacing
from torchrefrac.files.ply import DenseFileError


def write_arrays(arrays: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Write a NumPy archive under exactly this name."""
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_arrays(path: str | Path, file_format: str, axes: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Read the arrays that are named in `axes` from a NumPy archive whose array `format` is `file_format`.

    axes: a letter for each dimension of an array, the same one for sizes that must agree, or a digit, the size. Raises
    DenseFileError where the file is missing or damaged, of another format, lacks an array, or has one of other axes.
    """
    path = Path(path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            found = {name: archive[name] for name in ("format", *axes) if name in archive}
    except (OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise DenseFileError(f"{path} is not a whole NumPy archive: {error}") from None
    if str(found.get("format", "")) != file_format:
        raise DenseFileError(f"{path} has the format {str(found.get('format', ''))!r}, but must have {file_format!r}")
    missing = [name for name in axes if name not in found]
    if missing:
        raise DenseFileError(f"{path} lacks {', '.join(missing)}")
    sizes = {str(digit): digit for digit in range(10)}
    for name, letters in axes.items():
        shape, kind = found[name].shape, found[name].dtype.kind
        if letters and kind not in "biuf":
            raise DenseFileError(f"{path}: {name} has the type {found[name].dtype}, but must hold numbers")
        if len(shape) != len(letters) or any(
            sizes.setdefault(letter, size) != size for letter, size in zip(letters, shape, strict=True)
        ):
            raise DenseFileError(f"{path}: {name} has the shape {shape}, which does not fit ({', '.join(letters)})")
    return found
