"""Absolute pose of a camera with a known vertical above a water surface (paper, section 3.4.2).

With R_z the heading rotation, t = -R_z c and m = v_xy / v_z, a point under water obeys two equations linear in
(C, S, t):   (R_z p + o + t)_xy = m (R_z p + o + t)_z   with o = (-p_z m / g, -p_z). A point in air obeys the same with
o = 0, so that land and water points mix in one system. Behind layers p_z / g - T stands for p_z / g (see `layers`).
Degenerate: two points on one vertical line (2-point), all points on one vertical line (n-point).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.minimal.layers import Layers, Number
from torchrefrac.minimal.rays import Rays, cross2, require_rays, seen_along
from torchrefrac.numerics import determines, least_squares_on_circle

TwoPoses = tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2 3"], Bool[Tensor, "*batch 2"]]


def absolute_pose_2pt(
    rays: Float[Tensor, "*batch 2 3"],
    points: Float[Tensor, "*batch 2 3"],
    index_ratio: Number,
    *,
    layers: Layers | None = None,
) -> TwoPoses:
    """Closed-form pose from 2 level rays and their world points, lengths in one unit.

    layers: between the camera's medium and the water, from z = 0 down; a point among them counts as if it lay in water.
    Returns heading in radians, center and valid: up to two solutions of alpha C + beta S + gamma = 0 with
    C^2 + S^2 = 1. Valid means: real, finite, camera above the water.
    """
    require_rays("the 2-point solver", 2, index_ratio, layers=layers, rays=rays, points=points)
    return unchecked_absolute_pose_2pt(rays, points, index_ratio, layers=layers)


def unchecked_absolute_pose_2pt(
    rays: Float[Tensor, "*batch 2 3"],
    points: Float[Tensor, "*batch 2 3"],
    index_ratio: Number,
    *,
    layers: Layers | None = None,
) -> TwoPoses:
    """`absolute_pose_2pt` of arguments that are known to be right."""
    m, x, y, const = _terms(rays, points, index_ratio, layers)
    # Rows per point: x C + y' S + const + t_xy - m t_z = 0. The difference of the two points frees t_xy,
    # the direction across the difference of slopes frees t_z.
    dm = m[..., 0, :] - m[..., 1, :]
    dx, dy, dc = (q[..., 0, :] - q[..., 1, :] for q in (x, y, const))
    alpha, beta, gamma = cross2(dm, dx), cross2(dm, dy), cross2(dm, dc)
    radius = torch.hypot(alpha, beta)
    cosine = -gamma / radius.clamp(min=torch.finfo(rays.dtype).tiny)
    real = (cosine.abs() <= 1.0) & (radius > 0.0)
    opening = cosine.clamp(-1.0, 1.0).acos()
    middle = torch.atan2(beta, alpha)
    heading = torch.stack((middle + opening, middle - opening), dim=-1)
    c, s = heading.cos()[..., None], heading.sin()[..., None]
    moved = c * dx[..., None, :] + s * dy[..., None, :] + dc[..., None, :]
    norm = dm.square().sum(dim=-1)[..., None].clamp(min=torch.finfo(rays.dtype).tiny)
    t_z = (moved * dm[..., None, :]).sum(dim=-1) / norm
    t_xy = m[..., None, 0, :] * t_z[..., None] - (
        c * x[..., None, 0, :] + s * y[..., None, 0, :] + const[..., None, 0, :]
    )
    center = _center(heading, torch.cat((t_xy, t_z[..., None]), dim=-1))
    valid = real[..., None] & center.isfinite().all(dim=-1) & (center[..., 2] > 0.0)
    return heading, torch.where(valid[..., None], center, torch.ones_like(center)), valid


def absolute_pose_lsqi(
    rays: Rays,
    points: Rays,
    index_ratio: Number,
    weights: Float[Tensor, "*batch n"] | None = None,
    *,
    layers: Layers | None = None,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
    """Least-squares pose from n >= 3 level rays and world points, lengths in one unit.

    weights: zero for a point that does not count; layers: as for `absolute_pose_2pt`. The translation leaves by QR;
    what remains is a linear least-squares problem on the unit circle (LSQI). Returns heading, center, valid: both are
    determined, the camera above the water.
    """
    require_rays("least squares", 3, index_ratio, weights, or_more=True, layers=layers, rays=rays, points=points)
    m, x, y, const = _terms(rays, points, index_ratio, layers)
    unit = torch.eye(2, dtype=m.dtype, device=m.device).expand(*m.shape, 2)
    system = torch.cat((unit, -m[..., None], x[..., None], y[..., None], const[..., None]), dim=-1)
    if weights is not None:
        system = system * weights[..., None, None]
    triangle = torch.linalg.qr(system.flatten(-3, -2), mode="r").R
    head, rest = triangle[..., :3, :3], triangle[..., 3:, 3:]
    slope, offset = rest[..., :2], rest[..., 2]
    y_unit = least_squares_on_circle(slope.mT @ slope, -(slope.mT @ offset[..., None])[..., 0])
    target = triangle[..., :3, 3:5] @ y_unit[..., None] + triangle[..., :3, 5:6]
    translation, info = torch.linalg.solve_ex(head, -target)
    heading = torch.atan2(y_unit[..., 1], y_unit[..., 0])
    center = _center(heading, translation[..., 0])
    valid = determines(triangle, 3, 2) & (info == 0) & center.isfinite().all(dim=-1) & (center[..., 2] > 0.0)
    return heading, torch.where(valid[..., None], center, torch.ones_like(center)), valid


def _terms(
    rays: Rays, points: Rays, index_ratio: Number, layers: Layers | None
) -> tuple[Float[Tensor, "*batch n 2"], ...]:
    """Slopes m and the coefficients of C, of S and of 1 in the two equations of a point."""
    px, py, pz = points.unbind(dim=-1)
    m, apparent_z = seen_along(rays, pz, index_ratio, layers)
    return m, torch.stack((px, py), dim=-1), torch.stack((-py, px), dim=-1), -m * apparent_z[..., None]


def _center(heading: Float[Tensor, "*batch"], translation: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """c = -R_z^T t."""
    c, s = heading.cos(), heading.sin()
    tx, ty, tz = translation.unbind(dim=-1)
    return -torch.stack((c * tx + s * ty, c * ty - s * tx, tz), dim=-1)
