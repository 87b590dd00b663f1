"""NumPy archives, written whole and read with every array checked."""

import struct
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from torchrefrac.atomic import replacing

Array = Shaped[np.ndarray, "..."]
DAMAGE = (OSError, ValueError, EOFError, TypeError, RuntimeError, struct.error, zipfile.BadZipFile, zlib.error)
KINDS = {
    "n": ("numbers", "a finite number", np.float64),
    "i": ("whole numbers", "a whole number", np.int64),
    "c": ("bytes", "a byte", np.uint8),
    "b": ("truth values", "a truth value", np.bool_),
    "f": ("floating-point", "a floating-point number", None),
    "U": ("texts", "a text", None),
}
"""What arrays may hold, in words for several and for one, and the type that they are read as: their own without one."""


def write_arrays(arrays: Mapping[str, Array], path: str | Path) -> None:
    """Write a NumPy archive under exactly this name."""
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_arrays(
    path: str | Path,
    wanted: Mapping[str, str],
    error: Callable[[str], Exception],
    file_format: str | None = None,
    optional: Collection[str] = (),
) -> dict[str, Array]:
    """Read the arrays that are named in `wanted` from a NumPy archive whose array `format`, if one is given, is
    `file_format`.

    wanted: of each array a letter for what it holds (see `KINDS`), a colon, and a letter for each dimension: the same
    one for sizes that must agree, or a digit, the size. optional: which of them may be missing. Raises `error` of a
    sentence where the file is missing or damaged, of another format, lacks another array, or has one of another kind or
    other axes.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            found = {name: archive[name] for name in ("format", *wanted) if name in archive}
    except DAMAGE as problem:
        raise error(f"{path} is not a whole NumPy archive: {problem}") from None
    if file_format is not None and str(found.get("format", "")) != file_format:
        raise error(f"{path} has the format {str(found.get('format', ''))!r}, but must have {file_format!r}")
    missing = [name for name in wanted if name not in found and name not in optional]
    if missing:
        raise error(f"{path} lacks {', '.join(missing)}")
    sizes = {str(digit): digit for digit in range(10)}
    for name, (kind, _, *axes) in wanted.items():
        if name not in found:
            continue
        value, (several, one, dtype) = found[name], KINDS[kind]
        fits = value.dtype.kind == kind if dtype is None else np.can_cast(value.dtype, dtype, "safe")
        if not axes and not (fits and value.shape == () and (kind != "n" or np.isfinite(value))):
            raise error(f"{path}: {name} is {value}, but must be {one}")
        known = [sizes.get(letter, letter) for letter in axes]
        same = len(known) == value.ndim and all(
            sizes.setdefault(letter, size) == size for letter, size in zip(axes, value.shape, strict=True)
        )
        if axes and not (fits and same):
            wants = f"{several} ({', '.join(map(str, known))})"
            raise error(f"{path}: {name} is {value.dtype} {value.shape}, but must be {wants}")
        if dtype is not None:
            found[name] = value.astype(dtype, copy=False)
    return found
