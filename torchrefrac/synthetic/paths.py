"""Where cameras stand and where they look. World z up; camera x right, y down, z forward."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def look_at(
    center: Float[Tensor, "*#batch 3"],
    target: Float[Tensor, "*#batch 3"],
    roll: Float[Tensor, "*#batch"] | float = 0.0,
    *,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Float[Tensor, "*batch 3 3"]:
    """`cam_from_world` of cameras at center that look at target.

    The image's top points towards the world direction `up`, or to world +y where a camera looks along `up`; then each
    camera is turned by `roll`, radians, about its optical axis, x towards y. Cameras that look nearly straight
    down want +y for `up`. Raises ValueError where a camera stands at its target.
    """
    forward = target - center
    distance = forward.norm(dim=-1, keepdim=True)
    if bool((distance == 0.0).any()):
        raise ValueError("target is a camera's own center somewhere, but must lie apart from it")
    forward = forward / distance
    upright = torch.tensor(up, dtype=forward.dtype).expand_as(forward)
    north = torch.tensor((0.0, 1.0, 0.0), dtype=forward.dtype).expand_as(forward)
    right = torch.linalg.cross(forward, upright)
    along = right.norm(dim=-1, keepdim=True) < 1e-9
    right = torch.nn.functional.normalize(torch.where(along, torch.linalg.cross(forward, north), right), dim=-1)
    down = torch.linalg.cross(forward, right)
    roll = torch.as_tensor(roll, dtype=forward.dtype)[..., None]
    c, s = roll.cos(), roll.sin()
    return torch.stack((c * right + s * down, c * down - s * right, forward.expand_as(right)), dim=-2)


def ring(
    images: int, radius: float | tuple[float, float], heights: Sequence[float], sector_deg: tuple[float, float]
) -> Float[Tensor, "images 3"]:
    """Centres on a circle, or an ellipse with two radii, about the z axis, at `heights` in turn.

    They divide the sector (degrees, from +x towards +y) evenly; one of 360 degrees is not closed twice.
    """
    first, last = (math.radians(angle) for angle in sector_deg)
    steps = images if math.isclose(abs(last - first), 2.0 * math.pi) else images - 1
    angle = first + (last - first) * torch.arange(images, dtype=torch.float64) / max(steps, 1)
    across, along = (radius, radius) if isinstance(radius, int | float) else radius
    level = torch.tensor([heights[i % len(heights)] for i in range(images)], dtype=torch.float64)
    return torch.stack((across * angle.cos(), along * angle.sin(), level), dim=-1)


def grid(columns: int, rows: int, spacing: tuple[float, float], height: float) -> Float[Tensor, "images 3"]:
    """Centres of a grid about the z axis, flown row by row, to and fro."""
    x = spacing[0] * (torch.arange(columns, dtype=torch.float64) - 0.5 * (columns - 1))
    y = spacing[1] * (torch.arange(rows, dtype=torch.float64) - 0.5 * (rows - 1))
    lines = [torch.stack((x if row % 2 == 0 else x.flip(0), y[row].expand(columns)), dim=-1) for row in range(rows)]
    flown = torch.cat(lines)
    return torch.cat((flown, torch.full_like(flown[:, :1], height)), dim=-1)


def rolls(images: int, most_deg: float) -> Float[Tensor, " images"]:
    """Angles, radians, that vary as of a camera held in the hand, up to `most_deg` either way."""
    step = torch.arange(images, dtype=torch.float64)
    return math.radians(most_deg) * (2.4 * step + 0.7).sin()
