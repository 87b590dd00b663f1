"""What all clouds have in common."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.errors import TorchrefracError

CHUNK = 1_000_000  # points that are held at once
PREFIX = "corrected_"  # of the name of a field that the cloud has already


class CloudError(TorchrefracError, ValueError):
    """A cloud is missing or damaged, of a format that is not known, or has no points; the message names the file."""


@dataclass(frozen=True, eq=False)
class Changed:
    """Points of a cloud after a change: those that moved have new coordinates, all have more fields; what is not known
    of a point is NaN there."""

    coordinates: Float[Tensor, "n 3"]
    moved: Bool[Tensor, " n"]
    fields: Mapping[str, Float[Tensor, " n"]]


Change = Callable[[Float[Tensor, "n 3"]], Changed]
"""Of coordinates in float64, part by part, in the order of the file."""


class Cloud(Protocol):
    """A file of points. count: of them; crs: their reference system, in words that pyproj knows, where the file says
    it."""

    @property
    def count(self) -> int: ...

    @property
    def crs(self) -> str | None: ...

    def rewrite(self, target: Path, change: Change, fields: Mapping[str, str]) -> None:
        """Write the changed points to `target`, whole or not at all, in the same format and order, with everything that
        the file holds of them; coordinates of points that did not move stay as they are to the last bit.

        fields: of a changed point by name, and what each is. Raises CloudError where the file is damaged.
        """
        ...


def free_names(names: Iterable[str], taken: Iterable[str]) -> dict[str, str]:
    """A name that nothing has yet for each of some names."""
    used, free = {name.lower() for name in taken}, {}
    for name in names:
        chosen = name
        while chosen in used:
            chosen = PREFIX + chosen
        free[name] = chosen
    return free
