"""Oriented points as a picture: small discs seen along parallel rays, which hide what lies behind them."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

LEAST_COSINE = 0.15  # between the line of sight and a normal: flatter discs are drawn as if they were not
FRAGMENTS = 1 << 21  # of discs in pixels that are looked at once


class Window(NamedTuple):
    """Square pixels in the plane of the picture: left, top: of the first one's outer corner, size: of its side."""

    left: float
    top: float
    size: float
    rows: int
    columns: int


class _Part(NamedTuple):
    """What discs cover of pixels: which disc, which pixel, how near it is there, and how much it counts."""

    disc: Int[Tensor, " m"]
    pixel: Int[Tensor, " m"]
    near: Float[Tensor, " m"]
    weight: Float[Tensor, " m"]


def splat(
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    values: Float[Tensor, "n k"],
    radius: float,
    window: Window,
) -> tuple[Float[Tensor, "rows columns k"], Bool[Tensor, "rows columns"]]:
    """What is seen in each pixel of discs of this radius about points, and which pixels see any.

    points, normals: to the right, upwards and towards the viewer, in the unit of the window. Where several discs lie no
    farther than a radius behind the nearest one, their values are averaged, the less the farther their centres are from
    the pixel (Zwicker et al., Surface splatting, 2001, without their filter). Discs are seen from either side.
    """
    count = window.rows * window.columns
    front = points.new_full((count,), -torch.inf)
    for part in _parts(points, normals, radius, window):
        front.scatter_reduce_(0, part.pixel, part.near, "amax")
    total = points.new_zeros(count, values.shape[-1] + 1)
    weighted = torch.cat((values, torch.ones_like(values[:, :1])), dim=-1)
    for part in _parts(points, normals, radius, window):
        seen = part.near > front[part.pixel] - radius
        total.index_add_(0, part.pixel[seen], part.weight[seen, None] * weighted[part.disc[seen]])
    weight = total[:, -1]
    mean = total[:, :-1] / weight.clamp(min=1e-12)[:, None]
    shape = (window.rows, window.columns)
    return mean.unflatten(0, shape), (weight > 0.0).unflatten(0, shape)


def _parts(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], radius: float, window: Window
) -> Iterator[_Part]:
    """Of all discs, some of them at a time."""
    reach = math.ceil(radius / window.size)
    steps = torch.arange(-reach, reach + 1)
    down, across = (axis.flatten() for axis in torch.meshgrid(steps, steps, indexing="ij"))
    inside = down**2 + across**2 <= (radius / window.size + 1.0) ** 2
    down, across = down[inside], across[inside]
    place = points[:, :2] - points.new_tensor((window.left, window.top))
    column, row = (place[:, 0] / window.size).floor().long(), (-place[:, 1] / window.size).floor().long()
    facing = torch.where(normals[:, 2:] < 0.0, -normals, normals)
    slope = -facing[:, :2] / facing[:, 2:].clamp(min=LEAST_COSINE)
    for some in torch.arange(len(points)).split(max(1, FRAGMENTS // len(down))):
        x, y = column[some, None] + across, row[some, None] + down
        right = (x.to(points) + 0.5) * window.size - place[some, :1]
        up = -(y.to(points) + 0.5) * window.size - place[some, 1:]
        rise = slope[some, :1] * right + slope[some, 1:] * up
        weight = 1.0 - (right**2 + up**2 + rise**2) / radius**2
        hit = (weight > 0.0) & (x >= 0) & (x < window.columns) & (y >= 0) & (y < window.rows)
        disc, near = some[:, None].expand_as(x)[hit], (points[some, 2:] + rise)[hit]
        yield _Part(disc, (y * window.columns + x)[hit], near, weight[hit])
