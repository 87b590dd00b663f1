"""Oriented planes in space."""

import math
from collections.abc import Sequence
from dataclasses import InitVar, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import at_least_single, require, require_broadcasting, require_ending
from torchrefrac.geometry.rotation import rotate, so3_exp
from torchrefrac.numerics import like, pick


@dataclass(frozen=True, eq=False)
class Plane:
    """The points x with normal . x = offset; `normal` points to the positive side.

    normal: any length but zero, it is scaled to one; offset: along the unit normal, in the unit of the points. Both may
    be plain numbers. The default is the plane z = 0 with z positive. Raises ValueError for a normal that is zero, not
    finite or not of three components, for an offset that is not finite, and for shapes that do not broadcast.
    check=False takes a unit normal and the offset as they are.
    """

    normal: Float[Tensor, "*#batch 3"] | Sequence[float] = (0.0, 0.0, 1.0)
    offset: Float[Tensor, "*#batch"] | float = 0.0
    check: InitVar[bool] = True

    def __post_init__(self, check: bool) -> None:
        if not check:
            return
        require(self.offset, "offset")
        if isinstance(self.normal, Tensor):
            normal = at_least_single(self.normal)
            require_ending(normal, "normal", (3,))
            length = normal.square().sum(dim=-1, keepdim=True).sqrt()
            require(length, "length of normal", above=0.0)
            object.__setattr__(self, "normal", normal / length)
            _ = self.shape
            return
        if len(self.normal) != 3:
            raise ValueError(f"normal has {len(self.normal)} components, but must have 3")
        length = math.hypot(*self.normal)
        require(length, "length of normal", above=0.0)
        object.__setattr__(self, "normal", tuple(value / length for value in self.normal))

    @classmethod
    def through(cls, point: Sequence[float], normal: Sequence[float]) -> "Plane":
        """The plane through a point, both given in plain numbers."""
        unit = cls(normal).normal
        return cls(normal, sum(float(n) * float(x) for n, x in zip(unit, point, strict=True)))

    def normal_like(self, reference: Float[Tensor, "..."]) -> Float[Tensor, "*batch 3"]:
        """The unit normal in the dtype and on the device of `reference`."""
        if isinstance(self.normal, Tensor):
            return like(self.normal, reference)
        return torch.stack([like(component, reference) for component in self.normal])

    def signed_distance(self, points: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch"]:
        """How far points lie on the positive side."""
        return (self.normal_like(points) * points).sum(dim=-1) - like(self.offset, points)

    def tangents_like(
        self, reference: Float[Tensor, "..."]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
        """Unit vectors in the plane, right-handed with its normal: x and y for the plane z = 0.

        Without a singular direction (Duff et al., JCGT 6(1), 2017).
        """
        x, y, z = self.normal_like(reference).unbind(dim=-1)
        sign = torch.where(z < 0.0, -1.0, 1.0).to(z.dtype)
        a = -1.0 / (sign + z)
        b = x * y * a
        return (
            torch.stack((1.0 + sign * x * x * a, sign * b, -sign * x), dim=-1),
            torch.stack((b, sign + y * y * a, -y), dim=-1),
        )

    def moved(self, tilt: Float[Tensor, "*#batch 2"], height: Float[Tensor, "*#batch"] | float = 0.0) -> "Plane":
        """Turned about the origin by `tilt`, radians about the two tangents; then raised by `height` along its normal.
        The coordinates in which derivatives by tilt and height are taken."""
        first, second = self.tangents_like(tilt)
        turn = so3_exp(tilt[..., :1] * first + tilt[..., 1:] * second)
        return Plane(rotate(turn, self.normal_like(tilt)), like(self.offset, tilt) + height, check=False)

    def in_frame(
        self, new_from_old_rotation: Float[Tensor, "*#batch 3 3"], origin: Float[Tensor, "*#batch 3"]
    ) -> "Plane":
        """The same plane in coordinates x_new = R (x_old - origin)."""
        return Plane(rotate(new_from_old_rotation, self.normal_like(origin)), -self.signed_distance(origin))

    @property
    def shape(self) -> torch.Size:
        """The batch shape *B."""
        normal = self.normal.shape[:-1] if isinstance(self.normal, Tensor) else ()
        offset = self.offset.shape if isinstance(self.offset, Tensor) else ()
        return require_broadcasting(normal=normal, offset=offset)

    def indexed(self, index: Any, batch: Sequence[int]) -> "Plane":
        """Those of some elements of a batch."""
        return Plane(pick(self.normal, index, batch, 1), pick(self.offset, index, batch), check=False)

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "Plane":
        """The same in another dtype or on another device; numbers fit any."""
        normal, offset = self.normal, self.offset
        return Plane(
            normal.to(dtype=dtype, device=device) if isinstance(normal, Tensor) else normal,
            offset.to(dtype=dtype, device=device) if isinstance(offset, Tensor) else offset,
            check=False,
        )
