"""How bright a surface on a grid is in slanting light, so that its relief can be seen."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

SHADE = 0.35  # how much darker than a lit slope one in the shade is
SUN_AZIMUTH_DEG, SUN_ALTITUDE_DEG = 315.0, 45.0


def hillshade(
    depth: Float[Tensor, "rows columns"], valid: Bool[Tensor, "rows columns"], size: float
) -> Float[Tensor, "rows columns"]:
    """From 0 (in the shade) to 1 (facing the sun): the cosine of the angle between the surface, of which depth is known
    in cells of this size, row 0 in the north, and light from the north-west at 45 degrees (Lambert's law)."""
    east, south = (_slope(depth, valid, size, axis) for axis in (1, 0))
    to_east, to_north, up = sun()
    # The normal of the surface z = -depth, with y to the north, is (east, -south, 1) before it is made a unit vector.
    cosine = (to_east * east - to_north * south + up) / (east**2 + south**2 + 1.0).sqrt()
    return cosine.clamp(min=0.0)


def sun() -> tuple[float, float, float]:
    """A unit vector to where light comes from: east, north, up."""
    azimuth, altitude = math.radians(SUN_AZIMUTH_DEG), math.radians(SUN_ALTITUDE_DEG)
    return math.sin(azimuth) * math.cos(altitude), math.cos(azimuth) * math.cos(altitude), math.sin(altitude)


def relief(
    depth: Float[Tensor, "rows columns"], valid: Bool[Tensor, "rows columns"], size: float
) -> Float[Tensor, "rows columns"]:
    """By what to multiply the colours of a map so that it shows the relief: 1 where it is level or lit, less in the
    shade. Arguments as of `hillshade`."""
    level = math.sin(math.radians(SUN_ALTITUDE_DEG))
    return 1.0 - SHADE * (1.0 - hillshade(depth, valid, size) / level).clamp(0.0, 1.0)


def _slope(
    depth: Float[Tensor, "rows columns"], valid: Bool[Tensor, "rows columns"], size: float, axis: int
) -> Float[Tensor, "rows columns"]:
    """Change of depth per length along an axis, central where both neighbours are valid, else zero."""
    slope = torch.zeros_like(depth)
    inner = depth.shape[axis] - 2
    if inner > 0:
        rise = depth.narrow(axis, 2, inner) - depth.narrow(axis, 0, inner)
        is_known = valid.narrow(axis, 2, inner) & valid.narrow(axis, 0, inner)
        slope.narrow(axis, 1, inner).copy_((rise / (2.0 * size)).where(is_known, 0.0))
    return slope
