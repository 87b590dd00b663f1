"""Poses of cameras whose vertical and heading are both known: only the centre is left, and it enters linearly.

Turned by the heading, a ray has the slopes m in air and w = m / g in the water (see `rays.slopes`).
Relative: two rays meet where (q_1 - q_2) x (w_1 - w_2) = 0 (x: 2D cross product), with q_1 = -h m_1 and
q_2 = c_xy - c_z m_2 the places where they enter the water: one linear equation in c a pair.
Absolute: a point obeys c_xy - c_z m = p_xy - m z, with z = p_z / g under water and z = p_z in air (Chang & Chen,
ICCV 2011, Eq. 9): two equations a point. Subtracting the means over the points leaves c_z alone.
Degenerate: as in `relative_pose`; all points on one ray.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.checks import require, require_broadcasting
from torchrefrac.minimal.layers import Layers, Number, over_height
from torchrefrac.minimal.rays import Rays, bent, cross2, look_down, meet_below, require_rays, seen_along
from torchrefrac.numerics import like
from torchrefrac.numerics.small import ROUNDING

Centers = tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]


def relative_pose_3pt(
    rays1: Float[Tensor, "*batch 3 3"],
    rays2: Float[Tensor, "*batch 3 3"],
    heading: Number,
    index_ratio: Number,
    height: Number = 1.0,
    *,
    layers: Layers | None = None,
) -> Centers:
    """Centre of the second camera from 3 pairs of level rays and its heading (radians) relative to the first.

    The first camera stands at (0, 0, height); layers: between the cameras' medium and the water, in its unit. Returns
    center and valid: the centre is determined and above the water, all rays go down and all three points lie in the
    water.
    """
    require_rays("the 3-point solver", 3, index_ratio, layers=layers, rays1=rays1, rays2=rays2)
    require_broadcasting(heading=like(heading, rays1).shape, rays=rays1.shape[:-2])
    require(heading, "heading")
    require(height, "height", above=0.0)
    return unchecked_relative_pose_3pt(rays1, rays2, heading, index_ratio, height, layers=layers)


def unchecked_relative_pose_3pt(
    rays1: Float[Tensor, "*batch 3 3"],
    rays2: Float[Tensor, "*batch 3 3"],
    heading: Number,
    index_ratio: Number,
    height: Number = 1.0,
    *,
    layers: Layers | None = None,
) -> Centers:
    """`relative_pose_3pt` of arguments that are known to be right."""
    layers = over_height(layers, height)
    first, second = bent(rays1, index_ratio, layers), bent(rays2, index_ratio, layers)
    m2, w2 = (_turned(level, like(heading, rays2)) for level in second[:2])
    second = second._replace(m=m2, w=w2)
    d = first.w - w2
    rows = torch.stack((-d[..., 1], d[..., 0], cross2(m2, d)), dim=-1)
    cofactors = torch.linalg.cross(rows.roll(-1, dims=-2), rows.roll(-2, dims=-2), dim=-1)
    determinant = (rows * cofactors)[..., 0, :].sum(dim=-1)
    target = cross2(first.from_one, d)
    if second.lift is not None:
        target = target - second.lift * rows[..., 2]
    center = (target[..., None] * cofactors).sum(dim=-2) / determinant[..., None]
    size = rows.norm(dim=-1).prod(dim=-1)
    valid = (determinant.abs() > ROUNDING * torch.finfo(rows.dtype).eps * size) & look_down(rays1, rays2)
    x, y, z = center[..., None].unbind(dim=-2)
    below = meet_below(torch.zeros_like(x), (x, y, z), first, second, layers)[..., 0]
    valid = valid & below & (center[..., 2] > 0.0) & center.isfinite().all(dim=-1)
    return torch.where(valid[..., None], center * like(height, rays1)[..., None], 1.0), valid


def absolute_pose_known_heading(
    rays: Rays,
    points: Rays,
    heading: Number,
    index_ratio: Number,
    weights: Float[Tensor, "*batch n"] | None = None,
    *,
    layers: Layers | None = None,
) -> Centers:
    """Least-squares centre of a camera with a known heading (radians) from n >= 2 level rays and world points.

    Lengths are in one unit. Points may lie in the water and on land. weights: zero for a point that does not count.
    layers: between the camera's medium and the water, from z = 0 down; a point among them counts as if it lay in water.
    Returns center and valid: the centre is determined and above the water. Which end of its ray a point lies on is not
    asked.
    """
    require_rays("the solver", 2, index_ratio, weights, or_more=True, layers=layers, rays=rays, points=points)
    require_broadcasting(heading=like(heading, rays).shape, rays=rays.shape[:-2])
    require(heading, "heading")
    return unchecked_absolute_pose_known_heading(rays, points, heading, index_ratio, weights, layers=layers)


def unchecked_absolute_pose_known_heading(
    rays: Rays,
    points: Rays,
    heading: Number,
    index_ratio: Number,
    weights: Float[Tensor, "*batch n"] | None = None,
    *,
    layers: Layers | None = None,
) -> Centers:
    """`absolute_pose_known_heading` of arguments that are known to be right."""
    level, apparent_z = seen_along(rays, points[..., 2], index_ratio, layers)
    m = _turned(level, like(heading, rays))
    target = points[..., :2] - m * apparent_z[..., None]
    share = torch.ones_like(apparent_z) if weights is None else weights.square()
    share = (share / share.sum(dim=-1, keepdim=True))[..., None]
    mean_m, mean_target = (share * m).sum(dim=-2), (share * target).sum(dim=-2)
    aside = m - mean_m[..., None, :]
    spread = (share * aside.square()).sum(dim=(-2, -1))
    center_z = -(share * aside * (target - mean_target[..., None, :])).sum(dim=(-2, -1)) / spread
    center = torch.cat((mean_target + mean_m * center_z[..., None], center_z[..., None]), dim=-1)
    rounding = ROUNDING * torch.finfo(rays.dtype).eps
    valid = (spread > rounding**2 * (share * m.square()).sum(dim=(-2, -1))) & (center_z > 0.0)
    valid = valid & center.isfinite().all(dim=-1)
    return torch.where(valid[..., None], center, 1.0), valid


def _turned(level: Float[Tensor, "*batch n 2"], heading: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch n 2"]:
    """Level vectors in the axes of the world."""
    c, s = heading.cos()[..., None], heading.sin()[..., None]
    x, y = level.unbind(dim=-1)
    return torch.stack((c * x + s * y, c * y - s * x), dim=-1)
