"""Work in many parts, each of which lies in a file once it is done: a run that was stopped goes on from there."""

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from torchrefrac.atomic import remove_unfinished, replacing
from torchrefrac.checks import TorchrefracError
from torchrefrac.files.fingerprint import fingerprint_of
from torchrefrac.files.npz import DAMAGE, Array, read_arrays, write_arrays
from torchrefrac.files.swap import remove_if_empty
from torchrefrac.parallel import Workers

J = TypeVar("J")
Arrays = Mapping[str, Array]
OWN = re.compile(r"[a-z]+-[0-9a-f]{16}")
"""Names of the folders of stages."""
PART = re.compile(r"part_\d{6}(\.npz|\.[a-z]+\.npy)")


class DamagedPartError(TorchrefracError, ValueError):
    """A part cannot be read; it is done once more."""


class Form(NamedTuple):
    """arrays: of a part, as `read_arrays` takes them. mapped: further arrays, which stay on the disk and are read where
    they are looked at."""

    arrays: Mapping[str, str]
    mapped: Collection[str] = ()


@dataclass(frozen=True)
class Work:
    """Does work by `workers`, by default in this process, and leaves its parts in `folder`, or nowhere."""

    workers: Workers = field(default_factory=Workers)
    folder: Path | None = None

    def parts(
        self,
        stage: str,
        made_from: Sequence[Any],
        function: Callable[[J], Arrays],
        jobs: Sequence[J],
        form: Form,
        seconds: float,
    ) -> Iterator[tuple[int, Arrays]]:
        """The number of each job, and the arrays that `function` makes of it: those that lie in the folder from before
        first, then the others as they are done.

        stage: a name of small letters; made_from: all that decides what comes out, see `fingerprint_of`;
        seconds: about how long a job takes.
        """
        if self.folder is None:
            yield from self.workers.each(function, jobs, seconds)
            return
        place = self.folder / f"{stage}-{fingerprint_of(*made_from)}"
        left = []
        for number in range(len(jobs)):
            found = _read(place, number, form)
            if found is None:
                left.append(number)
            else:
                yield number, found
        for number, arrays in self.workers.each(function, [jobs[number] for number in left], seconds):
            yield left[number], _write(arrays, place, left[number], form)

    def clear(self) -> None:
        """Remove all parts, and the folders that they are in."""
        if self.folder is None or not self.folder.is_dir():
            return
        for place in self.folder.iterdir():
            if place.is_dir() and OWN.fullmatch(place.name):
                remove_unfinished(place)
                for path in place.iterdir():
                    if PART.fullmatch(path.name):
                        path.unlink(missing_ok=True)
                remove_if_empty(place, self.folder.parent)


def _path(place: Path, number: int, name: str = "") -> Path:
    return place / (f"part_{number:06d}.{name}.npy" if name else f"part_{number:06d}.npz")


def _write(arrays: Arrays, place: Path, number: int, form: Form) -> Arrays:
    """The arrays as they are there afterwards; the archive comes last, and without it nothing counts."""
    if not form.mapped:
        write_arrays(arrays, _path(place, number))
        return arrays
    for name in form.mapped:
        with replacing(_path(place, number, name)) as temporary:
            np.save(temporary, arrays[name])
    write_arrays({name: arrays[name] for name in form.arrays}, _path(place, number))
    found = _read(place, number, form)
    return arrays if found is None else found


def _read(place: Path, number: int, form: Form) -> Arrays | None:
    if not _path(place, number).is_file():
        return None
    try:
        found = read_arrays(_path(place, number), form.arrays, DamagedPartError)
        mapped = {name: np.load(_path(place, number, name), mmap_mode="c") for name in form.mapped}
    except (DamagedPartError, *DAMAGE):
        return None
    return found | mapped
