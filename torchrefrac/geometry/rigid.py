"""Rigid motions between frames."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry.rotation import rotate


@dataclass(frozen=True, eq=False)
class Rigid:
    """`b_from_a`: x_in_b = rotation @ (x_in_a - center). For a camera, `cam_from_world`: center is where it stands.
    Lengths are in one unit, whichever.

    Motions compose where names touch: `c_from_a = c_from_b @ b_from_a`.
    """

    rotation: Float[Tensor, "*batch 3 3"]
    center: Float[Tensor, "*batch 3"]

    @classmethod
    def identity(cls, *batch: int, dtype: torch.dtype = torch.float64) -> "Rigid":
        """Frames that are the same."""
        return cls(torch.eye(3, dtype=dtype).repeat(*batch, 1, 1), torch.zeros(*batch, 3, dtype=dtype))

    def __len__(self) -> int:
        return len(self.center)

    def __getitem__(self, index: Any) -> "Rigid":
        """Some of a batch, as one indexes the first dimensions of a tensor."""
        return Rigid(self.rotation[index], self.center[index])

    def __matmul__(self, other: "Rigid") -> "Rigid":
        """This motion after the other."""
        return Rigid(self.rotation @ other.rotation, other.center + rotate(other.rotation.mT, self.center))

    @property
    def inverse(self) -> "Rigid":
        """`a_from_b`."""
        return Rigid(self.rotation.mT, -rotate(self.rotation, self.center))

    def apply(self, points: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
        """Coordinates in b of points in a."""
        return rotate(self.rotation, points - self.center)
