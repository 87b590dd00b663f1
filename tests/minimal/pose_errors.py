"""How far solved poses are from the truth, and what two rays of a pose do in the water."""

import torch

from torchrefrac.geometry import heading_rotation

WATER = 1.33
HEIGHT = 30.0  # of the first camera of a basin


def relative_error(heading, center, true_heading, true_center):
    """The larger of the error of the heading (radians) and that of the centre (part of the baseline)."""
    first = true_center.new_tensor((0.0, 0.0, HEIGHT))
    relative = (center - true_center).norm(dim=-1) / (true_center - first).norm(dim=-1)
    return torch.maximum(angle(heading - true_heading), relative)


def absolute_error(heading, center, true_heading, true_center):
    """The larger of the error of the heading (radians) and that of the centre (part of its height)."""
    relative = (center - true_center).norm(dim=-1) / true_center[..., 2]
    return torch.maximum(angle(heading - true_heading), relative)


def angle(difference):
    return torch.atan2(difference.sin(), difference.cos()).abs()


def depth_of_meeting(rays1, rays2, heading, center, height=1.0):
    """Depth (*B, n) below the water where the rays (*B, n, 3) of two cameras pass each other."""
    gap, spread = _gap_and_spread(rays1, rays2, heading, center, height)
    return (gap * spread).sum(dim=-1) / spread.square().sum(dim=-1)


def sine_of_missing(rays1, rays2, heading, center, height=1.0):
    """Zero (*B, n) where the rays (*B, n, 3) of two cameras meet in the water: a sine of the directions that matter."""
    gap, spread = _gap_and_spread(rays1, rays2, heading, center, height)
    area = gap[..., 0] * spread[..., 1] - gap[..., 1] * spread[..., 0]
    return area / (gap.norm(dim=-1) * spread.norm(dim=-1))


def _gap_and_spread(rays1, rays2, heading, center, height):
    """Horizontal vectors (*B, n, 2) between two rays: at the surface, and how much of it a unit of depth takes away."""
    first = center.new_tensor((0.0, 0.0, height)).expand_as(center)
    at1, slope1 = _into_water(rays1, first)
    at2, slope2 = _into_water(rays2 @ heading_rotation(heading), center)
    return at1 - at2, slope1 - slope2


def _into_water(rays, center):
    """Where rays in the axes of the world enter the water, and their slopes there, by Snell's law of the sines."""
    down = -rays[..., 2:]
    slope = rays[..., :2] / rays[..., 2:]
    sine = rays[..., :2].norm(dim=-1, keepdim=True) / rays.norm(dim=-1, keepdim=True) / WATER
    tangent = sine / (1.0 - sine.square()).sqrt()
    assert (down > 0.0).all()
    return center[..., None, :2] - center[..., None, 2:] * slope, slope * tangent / slope.norm(dim=-1, keepdim=True)
