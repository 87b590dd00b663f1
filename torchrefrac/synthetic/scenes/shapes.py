"""Rectangles and boxes as pieces of a scene, from plain numbers, and how pieces are moved."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry import rotate
from torchrefrac.geometry.surfaces import Cylinder, Rectangle, Surface
from torchrefrac.geometry.triangle_mesh import TriangleMesh

Vector = Sequence[float]


def vector(components: Vector) -> Float[Tensor, " n"]:
    return torch.tensor(components, dtype=torch.float64)


def rectangle(corner: Vector, edge1: Vector, edge2: Vector) -> Rectangle:
    """Its texture is upright and not mirrored where it is seen from the side that edge1 x edge2 points to."""
    return Rectangle(vector(corner), vector(edge1), vector(edge2))


def level_rectangle(low: Vector, high: Vector, z: float) -> Rectangle:
    """With sides along x and y, from `low` (2) to `high` (2), to be seen from above."""
    return rectangle((*low, z), (high[0] - low[0], 0.0, 0.0), (0.0, high[1] - low[1], 0.0))


def walls(corners: Sequence[Vector], low: float, high: float) -> list[Rectangle]:
    """Upright rectangles between neighbours of `corners` (n of 2), round and round, to be seen from outside where the
    corners go counter-clockwise, else from inside."""
    following = (*corners[1:], corners[0])
    return [
        rectangle((a[0], a[1], low), (b[0] - a[0], b[1] - a[1], 0.0), (0.0, 0.0, high - low))
        for a, b in zip(corners, following, strict=True)
    ]


def footprint(middle: Vector, size: Vector, turn_deg: float = 0.0) -> list[tuple[float, float]]:
    """Corners of a rectangle, counter-clockwise, turned about its middle."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    half = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
    offsets = [(x * size[0], y * size[1]) for x, y in half]
    return [(middle[0] + c * x - s * y, middle[1] + s * x + c * y) for x, y in offsets]


def moved(surface: Surface, rotation: Float[Tensor, "3 3"], origin: Float[Tensor, " 3"]) -> Surface:
    """The same surface where x = rotation x + origin. Raises TypeError for one of no known kind."""
    if isinstance(surface, Rectangle):
        return Rectangle(rotation @ surface.corner + origin, rotation @ surface.edge1, rotation @ surface.edge2)
    if isinstance(surface, Cylinder):
        return Cylinder(rotation @ surface.base + origin, rotation @ surface.axis, surface.radius)
    if isinstance(surface, TriangleMesh):
        return replace(surface, vertices=rotate(rotation, surface.vertices) + origin)
    raise TypeError(f"surface is {type(surface).__name__}, but must be a rectangle, a cylinder or a mesh of triangles")
