"""Patches: small oriented pieces of surface, each found in a pixel of its reference image."""

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera


@dataclass(frozen=True)
class Patches:
    """N patches. reference (N): index of the image; pixels (N, 2): where they are centred in it.

    points, normals (N, 3): world frame, the normals unit and towards the camera; sigma (N): standard deviation along
    the ray, footprint (N): how far one reference pixel reaches there, both in length_unit; score (N): mean ZNCC of the
    images that agree; others (N, V): images that the patch was compared with, and which of them agree: visible (N, V).
    """

    reference: Tensor
    pixels: Tensor
    points: Tensor
    normals: Tensor
    sigma: Tensor
    footprint: Tensor
    score: Tensor
    others: Tensor
    visible: Tensor

    def __len__(self) -> int:
        return len(self.reference)

    def __getitem__(self, rows: Tensor) -> "Patches":
        """Some of them, by a mask (N) or indices."""
        return Patches(*(getattr(self, f.name)[rows] for f in fields(self)))

    @property
    def thickness(self) -> Tensor:
        """How far off its plane another patch of the same surface may lie (N): a footprint, or 3 sigma."""
        return torch.maximum(self.footprint, 3.0 * self.sigma)

    def seen_by(self, image: int | Tensor) -> Tensor:
        """Which of them (N) their own comparison has shown to be seen by an image, or to be found in it."""
        return (self.reference == image) | ((self.others == image) & self.visible).any(dim=1)

    def facing(self, camera: RefractiveCamera) -> Tensor:
        """Which of them (N) a single camera stands before."""
        return (self.normals * (camera.center_in_world - self.points)).sum(dim=-1) > 0

    def padded(self, views: int) -> "Patches":
        """The same with V = views, the images that were not compared marked as not visible."""
        more = views - self.others.shape[1]
        if more <= 0:
            return self
        pad = torch.nn.functional.pad
        return replace(self, others=pad(self.others, (0, more)), visible=pad(self.visible, (0, more), value=False))

    def to(self, device: torch.device) -> "Patches":
        """The same on another device."""
        return Patches(*(getattr(self, f.name).to(device) for f in fields(self)))

    @property
    def views(self) -> Tensor:
        """How many images agree (N), the reference included."""
        return 1 + self.visible.sum(dim=1)

    @classmethod
    def empty(cls, views: int, device: torch.device | None = None) -> "Patches":
        """None, compared with so many others."""
        counts = torch.zeros(0, dtype=torch.long, device=device)
        numbers = torch.zeros(0, dtype=torch.float64, device=device)
        vectors, table = numbers.view(0, 1).expand(0, 3), counts.view(0, 1).expand(0, views)
        return cls(counts, vectors[:, :2], vectors, vectors, numbers, numbers, numbers, table, table > 0)

    @classmethod
    def together(cls, parts: list["Patches"]) -> "Patches":
        """One table of several with the same number of views."""
        return cls(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(cls)))
