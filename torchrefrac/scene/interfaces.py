"""Interfaces: the flat surfaces through which views look."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry import Plane
from torchrefrac.numerics import like
from torchrefrac.refraction import FlatInterface

MAX_INDEX_RATIO = 3.0  # beyond any liquid
INDEX_RATIO_RANGE = f"n_water / n_air lies between 1 and {MAX_INDEX_RATIO:g} (water: 1.333)"


@dataclass(frozen=True, eq=False)
class Interfaces:
    """A table of water surfaces normal . x = offset in the world frame, with unit normals towards the cameras, and what
    lies below: index_ratio is n_water / n_air."""

    normal: Float[Tensor, "e 3"]
    offset: Float[Tensor, " e"]
    index_ratio: Float[Tensor, " e"]

    @classmethod
    def level(cls, index_ratio: float | Float[Tensor, ""], height: float = 0.0) -> "Interfaces":
        """One horizontal surface, by default at z = 0."""
        ratio = torch.as_tensor(index_ratio, dtype=torch.float64).reshape(1)
        normal = ratio.new_tensor(((0.0, 0.0, 1.0),))
        return cls(normal, ratio.new_full((1,), height), ratio)

    @classmethod
    def of_plane(cls, plane: Plane, index_ratio: float) -> "Interfaces":
        """One surface in any plane."""
        ratio = torch.tensor([index_ratio], dtype=torch.float64)
        return cls(plane.normal_like(ratio)[None], like(plane.offset, ratio).reshape(1), ratio)

    def __len__(self) -> int:
        return len(self.offset)

    @cached_property
    def is_level(self) -> bool:
        """Whether there is one surface, the plane z = 0, of which nobody wants derivatives."""
        if self.normal.requires_grad or self.offset.requires_grad:
            return False
        return self.normal.tolist() == [[0.0, 0.0, 1.0]] and self.offset.tolist() == [0.0]

    @property
    def are_horizontal(self) -> bool:
        """Whether all surfaces are level, at any height."""
        return all(normal == [0.0, 0.0, 1.0] for normal in self.normal.tolist())

    @cached_property
    def is_air(self) -> bool:
        """Whether there is one surface, at which nothing refracts, and nobody wants derivatives."""
        return not self.index_ratio.requires_grad and self.index_ratio.tolist() == [1.0]

    def problem(self) -> str:
        """What cannot be right about the surfaces; empty where nothing is."""
        if not len(self):
            return "there must be at least one interface"
        if not (self.normal.norm(dim=-1) - 1.0).abs().max() < 1e-6 or not self.offset.isfinite().all():
            return "normal must hold unit vectors, and offset finite numbers"
        wrong = self.index_ratio[~((self.index_ratio >= 1.0) & (self.index_ratio <= MAX_INDEX_RATIO))].tolist()
        return f"index_ratio is {wrong[0]:g}, but {INDEX_RATIO_RANGE}" if wrong else ""

    @property
    def planes(self) -> Plane:
        """All surfaces as a batch (e)."""
        return Plane(self.normal, self.offset, check=False)

    def of_views(self, interface: Any, dry: Bool[Tensor, "*batch"] | None = None) -> FlatInterface:
        """What views with the interfaces `interface` (*B) look through, as a batch (*B); not batched where there is one
        for all. dry (*B): which of them look at something without water before it: their surface lies infinitely
        deep, so that nothing is beyond it."""
        if self.is_air:
            return FlatInterface(1.0)
        rows = 0 if len(self) == 1 else interface
        plane = Plane() if len(self) == 1 and self.is_level else self.planes.indexed(rows, (len(self),))
        if dry is not None:
            plane = Plane(plane.normal, without_water(self.offset[rows], dry), check=False)
        return FlatInterface(self.index_ratio[rows], plane=plane, check=False)

    def refract(self) -> bool:
        """Whether any of them bends a ray."""
        return bool((self.index_ratio > 1.0).any())

    def detached(self) -> "Interfaces":
        """The same without a graph."""
        return Interfaces(self.normal.detach(), self.offset.detach(), self.index_ratio.detach())


def without_water(offset: Float[Tensor, "*#batch"], dry: Bool[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
    """Offsets of surfaces, infinitely deep where it is dry: nothing lies beyond them then, and nothing depends on where
    they are."""
    return torch.where(dry, -torch.inf, offset)
