"""Polygons in a plane, such as the extent of a piece of water."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def inside_polygon(points: Float[Tensor, "*batch 2"], corners: Float[Tensor, "c 2"]) -> Bool[Tensor, "*batch"]:
    """Which points lie inside a polygon without crossings, its corners in order, either way round.

    A ray to the right crosses the border an odd number of times there. On the border itself either may be said.
    """
    corners, x, y = corners.to(points), points[..., :1], points[..., 1:]
    (x0, y0), (x1, y1) = corners.unbind(dim=-1), corners.roll(-1, dims=0).unbind(dim=-1)
    spans = (y0 > y) != (y1 > y)
    rise = torch.where(y1 == y0, 1.0, y1 - y0)
    right = x < x0 + (y - y0) / rise * (x1 - x0)
    return (spans & right).sum(dim=-1) % 2 == 1


def is_simple(corners: Float[Tensor, "c 2"]) -> bool:
    """Whether the sides of a polygon of three corners or more meet nowhere but at its corners, and it has an area."""
    count, following = len(corners), corners.roll(-1, dims=0)
    side = following - corners
    if not bool((side != 0.0).any(dim=-1).all()):
        return False
    to_first, to_second = (_turn(side[:, None], ends - corners[:, None]) for ends in (corners, following))
    parted = (to_first * to_second <= 0.0) & (to_first * to_second <= 0.0).T & _overlap(corners, following)
    number = torch.arange(count, device=corners.device)
    apart = (number[:, None] - number).abs()
    beside = (apart <= 1) | (apart == count - 1)
    back = (_turn(side, side.roll(-1, dims=0)) == 0.0) & ((side * side.roll(-1, dims=0)).sum(dim=-1) < 0.0)
    return not bool((parted & ~beside).any()) and not bool(back.any())


def _overlap(first: Float[Tensor, "c 2"], second: Float[Tensor, "c 2"]) -> Bool[Tensor, "c c"]:
    """Which pairs of sides have upright boxes that meet."""
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    return (low[:, None] <= high).all(dim=-1) & (low <= high[:, None]).all(dim=-1)


def _turn(first: Float[Tensor, "*#batch 2"], second: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch"]:
    """Positive where the second vector lies to the left of the first."""
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
