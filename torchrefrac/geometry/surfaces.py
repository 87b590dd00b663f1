"""Surfaces that a ray may meet, and the first one that it does meet. All in the world frame, in length units.

Vectors may lie in memory in any way; fastest are those that lie component by component, as `by_component` puts
them, and so are results.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

NEAREST = 1e-9  # of a hit, times the ray's length unit: a ray that starts on a surface does not meet it there


class Meeting(NamedTuple):
    """Where rays first meet one surface: length along the unit direction (infinite where they do not), texture
    coordinates and unit normals, both meaningless where they do not. Normals may point to either side."""

    length: Float[Tensor, " n"]
    uv: Float[Tensor, "n 2"]
    normal: Float[Tensor, "n 3"]


class Surface(Protocol):
    """Something that rays meet."""

    def intersect(self, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Meeting:
        """Where rays of these origins and unit directions, float64, meet the surface first."""
        ...

    def triangles(self) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
        """The surface as vertices and counter-clockwise faces; curved ones approximately."""
        ...


@dataclass(frozen=True, eq=False)
class Rectangle:
    """corner + u edge1 + v edge2 with u and v from 0 to 1. The texture coordinates are (u, v)."""

    corner: Float[Tensor, " 3"]
    edge1: Float[Tensor, " 3"]
    edge2: Float[Tensor, " 3"]

    @cached_property
    def frame(self) -> Float[Tensor, "3 3"]:
        """Rows: the unit normal, and what maps an offset from the corner to u and to v."""
        normal = normalize(torch.linalg.cross(self.edge1, self.edge2), dim=-1)
        return torch.cat((normal[None], torch.linalg.pinv(torch.stack((self.edge1, self.edge2), dim=-1))))

    def intersect(self, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Meeting:
        height, u, v = self.frame @ (origins - self.corner).mT
        slope, du, dv = self.frame @ directions.mT
        length = -height / torch.where(slope == 0.0, 1.0, slope)
        u, v = u + length * du, v + length * dv
        inside = (u >= 0.0) & (u <= 1.0) & (v >= 0.0) & (v <= 1.0) & (slope != 0.0) & (length > NEAREST)
        normal = self.frame[0][:, None].expand(3, len(u)).mT
        return Meeting(torch.where(inside, length, torch.inf), torch.stack((u, v)).mT, normal)

    def triangles(self) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
        a, b, c = self.corner, self.edge1, self.edge2
        return torch.stack((a, a + b, a + b + c, a + c)), torch.tensor([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A closed cylinder: from `base` along `axis`, which has its length, `radius` around it.

    Texture coordinates of the side: once around in u, from base to end in v (0 to 1). Of the two ends: the disc in its
    bounding square, u shifted by 1 for the base and by 2 for the other end.
    """

    base: Float[Tensor, " 3"]
    axis: Float[Tensor, " 3"]
    radius: float

    FACETS = 256

    @cached_property
    def frame(self) -> Float[Tensor, "3 3"]:
        """Rows: two unit vectors across, one along the axis."""
        along = normalize(self.axis, dim=-1)
        helper = torch.eye(3, dtype=along.dtype)[along.abs().argmin()]
        first = normalize(torch.linalg.cross(helper, along), dim=-1)
        return torch.stack((first, torch.linalg.cross(along, first), along))

    def intersect(self, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Meeting:
        start, way = (self.frame @ (origins - self.base).mT).mT, (self.frame @ directions.mT).mT
        height = float(self.axis.norm())
        length, normal, uv = self._side(start, way, height)
        for level, shift in ((0.0, 1.0), (height, 2.0)):
            reach = (level - start[:, 2]) / torch.where(way[:, 2] == 0.0, 1.0, way[:, 2])
            disc = (start + reach[:, None] * way)[:, :2] / self.radius
            nearer = (disc.square().sum(dim=-1) <= 1.0) & (way[:, 2] != 0.0) & (reach > NEAREST) & (reach < length)
            length = torch.where(nearer, reach, length)
            uv = torch.where(nearer[:, None], 0.5 * (disc + 1.0) + torch.tensor((shift, 0.0), dtype=uv.dtype), uv)
            normal = torch.where(nearer[:, None], torch.tensor((0.0, 0.0, 1.0), dtype=uv.dtype), normal)
        return Meeting(length, uv, (self.frame.mT @ normal.mT).mT)

    def _side(
        self, start: Float[Tensor, "n 3"], way: Float[Tensor, "n 3"], height: float
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, "n 2"]]:
        """The nearest of at most two crossings of the infinite cylinder that lies between the ends."""
        a = way[:, :2].square().sum(dim=-1)
        b = (start[:, :2] * way[:, :2]).sum(dim=-1)
        c = start[:, :2].square().sum(dim=-1) - self.radius**2
        root = b.square() - a * c
        meets = (root > 0.0) & (a > 0.0)
        root, a = torch.where(meets, root, 0.0).sqrt(), torch.where(a > 0.0, a, 1.0)
        length = torch.full_like(a, torch.inf)
        for reach in ((-b + root) / a, (-b - root) / a):
            level = start[:, 2] + reach * way[:, 2]
            length = torch.where(meets & (reach > NEAREST) & (level >= 0.0) & (level <= height), reach, length)
        place = start + torch.where(length.isfinite(), length, 0.0)[:, None] * way
        around = torch.atan2(place[:, 1], place[:, 0]) / (2.0 * torch.pi)
        uv = torch.stack((around.remainder(1.0), place[:, 2] / height)).mT
        return length, place * torch.tensor((1.0, 1.0, 0.0), dtype=place.dtype) / self.radius, uv

    def triangles(self) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
        angle = torch.arange(self.FACETS, dtype=torch.float64) * (2.0 * torch.pi / self.FACETS)
        ring = self.radius * torch.stack((angle.cos(), angle.sin()), dim=-1) @ self.frame[:2] + self.base
        vertices = torch.cat((ring, ring + self.axis, self.base[None], (self.base + self.axis)[None]))
        n, first = self.FACETS, torch.arange(self.FACETS)
        second = (first + 1) % n
        low, high = torch.full_like(first, 2 * n), torch.full_like(first, 2 * n + 1)
        faces = (
            (first, second, second + n), (first, second + n, first + n),
            (second, first, low), (first + n, second + n, high),
        )  # fmt: skip
        return vertices, torch.cat([torch.stack(face, dim=-1) for face in faces])


class Nearest(NamedTuple):
    """What rays meet first among several surfaces: `surface` is its index, -1 where they meet none."""

    length: Float[Tensor, " n"]
    surface: Int[Tensor, " n"]
    uv: Float[Tensor, "n 2"]
    normal: Float[Tensor, "n 3"]


def nearest(surfaces: Sequence[Surface], origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Nearest:
    """The first of `surfaces` that rays of these origins and unit directions meet."""
    uv, normal = (origins.new_zeros(components, len(origins)).mT for components in (2, 3))
    best = Nearest(torch.full_like(origins[:, 0], torch.inf), torch.full(origins.shape[:1], -1), uv, normal)
    for index, surface in enumerate(surfaces):
        met = surface.intersect(origins, directions)
        nearer = met.length < best.length
        if not bool(nearer.any()):
            continue
        best = Nearest(
            torch.where(nearer, met.length, best.length),
            torch.where(nearer, index, best.surface),
            torch.where(nearer[:, None], met.uv, best.uv),
            torch.where(nearer[:, None], met.normal, best.normal),
        )
    return best


def by_component(vectors: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The same vectors, one component after the other in memory."""
    return vectors.mT.contiguous().mT
