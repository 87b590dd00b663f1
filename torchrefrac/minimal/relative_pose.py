"""Relative pose of two cameras above one water surface, both with a known vertical (paper, section 3.4.1).

The first camera stands at (0, 0, h) with heading 0; the second has heading phi and centre c. A correspondence
fixes the depth of its point, and eliminating it leaves one equation e . x = 0 that is linear in

    x = [C, S, c_z C, c_z S, C c_x - S c_y, S c_x + C c_y, c_x, c_y],    C = cos(phi), S = sin(phi),

with the constraint C^2 + S^2 = 1. Degenerate (the paper's two cases, and one more): all points in the vertical plane
through both centres; equal heights and all points in the bisecting plane of the baseline; index ratio 1, where the
water surface and with it the scale cannot be seen.
"""

import torch
from torch import Tensor

from torchrefrac.minimal.rays import cross2, slopes
from torchrefrac.numerics import smallest_eigenvector_2x2


def relative_pose_7pt(
    rays1: Tensor, rays2: Tensor, index_ratio: Tensor | float, height: Tensor | float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Pose of the second camera from 7 pairs of level rays (*B, 7, 3); see `relative_pose_npt`."""
    if rays1.shape[-2] != 7:
        raise ValueError(f"rays1 has {rays1.shape[-2]} rays, but the 7-point solver takes exactly 7")
    return relative_pose_npt(rays1, rays2, index_ratio, height)


def relative_pose_npt(
    rays1: Tensor,
    rays2: Tensor,
    index_ratio: Tensor | float,
    height: Tensor | float = 1.0,
    weights: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Linear pose of the second camera from n >= 7 pairs of level rays.

    rays1, rays2 (*B, n, 3), z up, each in its own camera's level frame; height (*B) or a number is that of the first
    camera and sets the scale; weights (*B, n), zero for a pair that does not count.
    Minimises |E x| with C^2 + S^2 = 1: the last six unknowns leave by QR, a 2x2 eigenproblem remains.
    Returns heading (*B, 2) in radians, center (*B, 2, 3) and valid (*B, 2) of the two candidates x and -x, the
    consistent one first. Valid means: finite, second camera above the water.
    """
    if rays1.shape != rays2.shape or rays1.shape[-1:] != (3,):
        raise ValueError(f"rays1 {tuple(rays1.shape)} and rays2 {tuple(rays2.shape)} must both be (*B, n, 3)")
    if rays1.shape[-2] < 7:
        raise ValueError(f"rays1 has {rays1.shape[-2]} rays, but the linear solver needs at least 7")
    index = torch.as_tensor(index_ratio, dtype=rays1.dtype, device=rays1.device)[..., None]
    scale = torch.as_tensor(height, dtype=rays1.dtype, device=rays1.device)
    rows = _rows(rays1, rays2, index)
    if weights is not None:
        rows = rows * weights[..., None]
    return _solve(rows, scale)


def _rows(rays1: Tensor, rays2: Tensor, index: Tensor) -> Tensor:
    """The equations e (*B, n, 8), for a first camera at height 1."""
    m1, g1 = slopes(rays1, index)
    m2, g2 = slopes(rays2, index)
    in_water = m1 / g1[..., None]
    n2 = torch.stack((m2[..., 1], -m2[..., 0]), dim=-1)
    return torch.stack(
        (
            cross2(m2, m1) / g2,
            cross2(n2, m1) / g2,
            cross2(in_water, m2),
            cross2(in_water, n2),
            -m2[..., 1] / g2,
            m2[..., 0] / g2,
            in_water[..., 1],
            -in_water[..., 0],
        ),
        dim=-1,
    )


def _solve(rows: Tensor, scale: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    triangle = torch.linalg.qr(torch.cat((rows[..., 2:], rows[..., :2]), dim=-1), mode="r").R
    if triangle.shape[-2] < 8:
        triangle = torch.nn.functional.pad(triangle, (0, 0, 0, 8 - triangle.shape[-2]))
    head, coupling, rest = triangle[..., :6, :6], triangle[..., :6, 6:], triangle[..., 6:, 6:]
    cosine_sine = smallest_eigenvector_2x2(rest.mT @ rest)
    tail, info = torch.linalg.solve_ex(head, -(coupling @ cosine_sine[..., None]))
    tail = tail[..., 0]
    c, s = cosine_sine.unbind(dim=-1)
    center_z = c * tail[..., 0] + s * tail[..., 1]
    # The same centre twice, once through the rotation: they agree for the right sign of x and cancel for the other.
    turned = torch.stack((c * tail[..., 2] + s * tail[..., 3], c * tail[..., 3] - s * tail[..., 2]), dim=-1)
    direct = tail[..., 4:6]
    sign = torch.where((turned * direct).sum(dim=-1) >= 0.0, 1.0, -1.0).to(rows.dtype)
    heading = torch.atan2(sign * s, sign * c)
    horizontal = 0.5 * torch.stack((turned + sign[..., None] * direct, turned - sign[..., None] * direct), dim=-2)
    vertical = center_z[..., None, None].expand(*horizontal.shape[:-1], 1)
    center = torch.cat((horizontal, vertical), dim=-1) * scale[..., None, None]
    valid = (info == 0)[..., None] & center.isfinite().all(dim=-1) & (center[..., 2] > 0.0)
    center = torch.where(valid[..., None], center, torch.ones_like(center))
    return torch.stack((heading, heading + torch.pi), dim=-1), center, valid
