"""A number for all that something was made from, by which what was made before is known to be the same."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

LENGTH = 16


def fingerprint_of(*things: Any) -> str:
    """Hexadecimal digits that are the same for things that are the same: numbers, texts, arrays, and dataclasses,
    mappings and sequences of them. Of a path the name counts, wherever it lies, and of a file its size and time of
    change.

    Raises ValueError for something that is none of these.
    """
    digest = hashlib.sha256()
    for thing in things:
        _take(digest, thing)
    return digest.hexdigest()[:LENGTH]


def fingerprint_of_file(path: Path) -> str:
    """Hexadecimal digits that are the same for files of the same content, whatever they are called."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:LENGTH]


def _take(digest: "hashlib._Hash", thing: Any) -> None:
    digest.update(type(thing).__name__.encode() + b":")
    if thing is None or isinstance(thing, str | bytes | bool | int | float | Enum):
        digest.update(repr(thing).encode())
    elif isinstance(thing, Path):
        digest.update(repr(thing.name).encode())
        if thing.is_file():
            stat = thing.stat()
            digest.update(repr((stat.st_size, stat.st_mtime_ns)).encode())
    elif isinstance(thing, Tensor | np.ndarray | np.generic):
        array = np.ascontiguousarray(thing.detach().cpu().numpy() if isinstance(thing, Tensor) else thing)
        digest.update(repr((array.dtype.str, array.shape)).encode())
        digest.update(array.tobytes())
    elif is_dataclass(thing):
        for field in fields(thing):
            digest.update(field.name.encode() + b"=")
            _take(digest, getattr(thing, field.name))
    elif isinstance(thing, Mapping):
        _take(digest, sorted(map(repr, thing)))
        for key in sorted(thing, key=repr):
            _take(digest, thing[key])
    elif isinstance(thing, Sequence | set | frozenset):
        digest.update(repr(len(thing)).encode())
        for part in sorted(thing, key=repr) if isinstance(thing, set | frozenset) else thing:
            _take(digest, part)
    else:
        raise ValueError(f"a {type(thing).__name__} has no fingerprint")
    digest.update(b";")
