"""Patches: small oriented pieces of surface, each found in a pixel of its reference image."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.common_errors import CommonDeviations
from torchrefrac.scene import DenseCloud


class Planes(NamedTuple):
    """Guesses of patches, in the world frame; the normals of any length and either sign."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]

    def __getitem__(self, rows: Any) -> "Planes":  # type: ignore[override]
        """Some of them, as one indexes a tensor."""
        return Planes(self.points[rows], self.normals[rows])


@dataclass(frozen=True)
class Patches:
    """reference: the views that they were found in, centred at pixels.

    points and normals: world frame, the normals unit and towards the camera; sigma: standard deviation along the ray,
    footprint: how far one reference pixel reaches there, both in length_unit; score: mean ZNCC of the images that
    agree; others: views that each patch was compared with, and which of them agree: visible.
    """

    reference: Int[Tensor, " n"]
    pixels: Float[Tensor, "n 2"]
    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    sigma: Float[Tensor, " n"]
    footprint: Float[Tensor, " n"]
    score: Float[Tensor, " n"]
    others: Int[Tensor, "n v"]
    visible: Bool[Tensor, "n v"]

    def __len__(self) -> int:
        return len(self.reference)

    def __getitem__(self, rows: Bool[Tensor, " n"] | Int[Tensor, " k"]) -> "Patches":
        """Some of them, by a mask or indices."""
        return Patches(*(getattr(self, f.name)[rows] for f in fields(self)))

    def put(self, first: int, others: "Patches") -> None:
        """Take the values of others from the first row on."""
        for f in fields(self):
            getattr(self, f.name)[first : first + len(others)] = getattr(others, f.name)

    def thickness_of(self, rows: Int[Tensor, " k"]) -> Float[Tensor, " k"]:
        """How far off the planes of some of them another patch of the same surface may lie: a footprint, or 3 sigma."""
        return torch.maximum(self.footprint[rows], 3.0 * self.sigma[rows])

    def seen_by(self, view: int | Int[Tensor, ""]) -> Bool[Tensor, " n"]:
        """Which of them their own comparison has shown to be seen by a view, or to be found in it."""
        return (self.reference == view) | ((self.others == view) & self.visible).any(dim=1)

    def facing(self, camera: RefractiveCamera) -> Bool[Tensor, " n"]:
        """Which of them a single camera stands before."""
        return (self.normals * (camera.center_in_world - self.points)).sum(dim=-1) > 0

    def padded(self, views: int) -> "Patches":
        """The same with so many `others`; what was not compared is not visible."""
        more = views - self.others.shape[1]
        if more <= 0:
            return self
        pad = torch.nn.functional.pad
        return replace(self, others=pad(self.others, (0, more)), visible=pad(self.visible, (0, more), value=False))

    def to(self, device: torch.device) -> "Patches":
        """The same on another device."""
        return Patches(*(getattr(self, f.name).to(device) for f in fields(self)))

    def cloud(
        self, colors: UInt8[Tensor, "n 3"], rays: Float[Tensor, "n 3"], common: CommonDeviations, length_unit: str
    ) -> DenseCloud:
        """What remains of them where nobody asks for pixels any more. rays: unit vectors of their viewing rays, along
        which each is uncertain by itself."""
        sigma = torch.hypot(self.sigma, common.largest)
        axes = torch.hypot(self.sigma[:, None] * rays, common.along)
        known = (self.points, self.normals, colors, sigma, self.score, self.views, self.reference, self.sigma)
        return DenseCloud(*known, length_unit, axes, common.along[:, 2])

    @property
    def views(self) -> Int[Tensor, " n"]:
        """How many images agree, the reference included."""
        return 1 + self.visible.sum(dim=1)

    @classmethod
    def empty(cls, views: int, device: torch.device | None = None) -> "Patches":
        """None, compared with so many others."""
        return cls.room(0, views, partial(torch.zeros, device=device))

    @classmethod
    def room(cls, count: int, views: int, zeros: Callable[..., Shaped[Tensor, "..."]] = torch.zeros) -> "Patches":
        """Room for so many, compared with so many others. zeros: makes a tensor of a shape and, by name, a dtype."""
        counts, numbers = partial(zeros, dtype=torch.long), partial(zeros, dtype=torch.float64)
        return cls(
            counts((count,)), numbers((count, 2)), numbers((count, 3)), numbers((count, 3)), numbers((count,)),
            numbers((count,)), numbers((count,)), counts((count, views)), zeros((count, views), dtype=torch.bool),
        )  # fmt: skip

    @classmethod
    def together(cls, parts: list["Patches"]) -> "Patches":
        """One table of several with as many `others`."""
        return cls(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(cls)))
