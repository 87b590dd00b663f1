"""What a dense reconstruction consists of: oriented points, and what each image sees of the surface."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor


@dataclass(frozen=True)
class DenseCloud:
    """Oriented points on the surfaces of a scene, in its world frame (z up, water surface at z = 0).

    points in length_unit; normals: unit, towards the cameras; sigma: standard deviation of a point, with what is not
    known of cameras and water; relative_sigma: of its distance along its viewing ray, as if these were known, both in
    length_unit; score: mean zero-normalised cross-correlation (at most 1) of the reference view with the
    others; views: by how many a point is seen, the reference included; reference: index of the reference view.
    axis_sigma: standard deviations along x, y and z, by default sigma; common_sigma: the part of that along z which a
    point has in common with those about it, as it is that of cameras and water, by default what sigma has beyond
    relative_sigma.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    colors: UInt8[Tensor, "n 3"]
    sigma: Float[Tensor, " n"]
    score: Float[Tensor, " n"]
    views: Int[Tensor, " n"]
    reference: Int[Tensor, " n"]
    relative_sigma: Float[Tensor, " n"]
    length_unit: str
    axis_sigma: Float[Tensor, "a 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    common_sigma: Float[Tensor, " a"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))

    def __post_init__(self) -> None:
        if len(self.axis_sigma) != len(self):
            beyond = (self.sigma.square() - self.relative_sigma.square()).clamp(min=0.0).sqrt()
            object.__setattr__(self, "axis_sigma", self.sigma[:, None].expand(-1, 3))
            object.__setattr__(self, "common_sigma", beyond)

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: Bool[Tensor, " n"] | Int[Tensor, " k"]) -> "DenseCloud":
        """Some of the points, by a mask or indices."""
        names = (f.name for f in fields(self) if f.name != "length_unit")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @classmethod
    def joined(cls, clouds: Sequence["DenseCloud"]) -> "DenseCloud":
        """One or more as one, in their order."""
        first = clouds[0]
        names = (f.name for f in fields(first) if f.name != "length_unit")
        return replace(first, **{name: torch.cat([getattr(cloud, name) for cloud in clouds]) for name in names})

    @classmethod
    def empty(cls, length_unit: str) -> "DenseCloud":
        """Without a point."""
        vectors, numbers = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
        counts = torch.zeros(0, dtype=torch.long)
        return cls(vectors, vectors, vectors.to(torch.uint8), numbers, numbers, counts, counts, numbers, length_unit)


@dataclass(frozen=True)
class DepthMap:
    """What one view sees of the surface, on a grid of h x w cells of `step` x `step` pixels.

    Where valid: points in the world frame, at the cell's centre, of row i and column j the pixel (step (j + 1/2),
    step (i + 1/2)); depth: their z in the camera's frame, the ordinary depth (not the apparent one); sigma along the
    viewing ray. In length_unit; zero where not valid.
    """

    name: str
    step: int
    points: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
    sigma: Float[Tensor, "h w"]
    valid: Bool[Tensor, "h w"]
    length_unit: str
