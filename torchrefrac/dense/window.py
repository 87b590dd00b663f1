"""The square of reference pixels that a patch covers, and the three of its places that carry its plane.

A plane is given by its distances along three reference rays, around the window's centre. Each of the three points is
projected exactly; between them the warp is linear, a local affinity. The three lie at the window's own RMS radius: the
warp's curvature, which no affinity follows, then shifts the window as a whole by nothing.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

CORNERS = 3


@dataclass(frozen=True)
class Window:
    """size: pixels across, odd; spacing: distance of neighbouring samples in reference pixels."""

    size: int = 7
    spacing: float = 1.0

    @classmethod
    @lru_cache(maxsize=16)
    def across(cls, size: int) -> "Window":
        """The same one each time for so many pixels, whose numbers are worked out once."""
        return cls(size)

    @cached_property
    def offsets(self) -> Float[Tensor, "k 2"]:
        """In reference pixels (x, y), row by row."""
        half = (self.size - 1) / 2
        steps = self.spacing * torch.linspace(-half, half, self.size, dtype=torch.float64)
        y, x = torch.meshgrid(steps, steps, indexing="ij")
        return torch.stack((x.reshape(-1), y.reshape(-1)), dim=-1)

    @cached_property
    def radius(self) -> float:
        """Root mean square distance of the samples from the centre."""
        return float(self.offsets.square().sum(dim=-1).mean().sqrt())

    @cached_property
    def corners(self) -> Float[Tensor, "3 2"]:
        """Where the three rays pierce the image, relative to the centre."""
        angle = 2.0 * math.pi * torch.arange(CORNERS, dtype=torch.float64) / CORNERS
        return self.radius * torch.stack((angle.cos(), angle.sin()), dim=-1)

    @cached_property
    def weights(self) -> Float[Tensor, "k 3"]:
        """Each sample as the sum of the corners, so weighted; rows add up to 1."""
        return (1.0 + 2.0 * (self.offsets @ self.corners.T) / self.radius**2) / CORNERS

    @cached_property
    def places(self) -> Float[Tensor, "6 pixels"]:
        """What takes the corners' pixels (3, 2), row by row, to those of all samples (k, 2)."""
        return torch.kron(self.weights, torch.eye(2, dtype=torch.float64)).T

    @cached_property
    def outer(self) -> Float[Tensor, "6 pixels"]:
        """`places` of the window's four outermost samples."""
        last = self.size - 1
        return self.places.view(2 * CORNERS, -1, 2)[:, [0, last, self.size * last, self.size**2 - 1]].flatten(1)

    @cached_property
    def basis(self) -> Float[Tensor, "3 3"]:
        """The three distances from (distance, slope along x, slope along y), slopes over one radius."""
        return torch.cat((torch.ones(CORNERS, 1, dtype=torch.float64), self.corners / self.radius), dim=-1)

    @cached_property
    def squared_basis(self) -> Float[Tensor, "9 9"]:
        """What takes products in pairs of derivatives in the three distances, row by row, to those in (distance, slope
        along x, slope along y)."""
        return torch.kron(self.basis, self.basis)
