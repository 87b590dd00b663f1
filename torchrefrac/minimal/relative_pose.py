"""Relative pose of two cameras above one water surface, both with a known vertical (paper, section 3.4.1).

The first camera stands at (0, 0, h) with heading 0; the second has heading phi and centre c. A correspondence
fixes the depth of its point, and eliminating it leaves one equation e . x = 0 that is linear in

    x = [C, S, c_z C, c_z S, C c_x - S c_y, S c_x + C c_y, c_x, c_y],    C = cos(phi), S = sin(phi),

with the constraint C^2 + S^2 = 1. Behind layers c_z + T stands for c_z and h + T for h (see `layers`), which changes
coefficients alone. Degenerate (the paper's two cases, and one more): all points in the vertical plane through both
centres; equal heights and all points in the bisecting plane of the baseline; index ratio 1, where the water surface and
with it the scale cannot be seen.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.minimal.layers import Layers, Number, over_height
from torchrefrac.minimal.rays import Rays, Slopes, bent, cross2, look_down, meet_below, require_rays
from torchrefrac.numerics import determines, like, smallest_eigenvector_2x2

Poses = tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2 3"], Bool[Tensor, "*batch 2"]]


def relative_pose_7pt(
    rays1: Float[Tensor, "*batch 7 3"],
    rays2: Float[Tensor, "*batch 7 3"],
    index_ratio: Number,
    height: Number = 1.0,
    *,
    layers: Layers | None = None,
) -> Poses:
    """Pose of the second camera from 7 pairs of level rays, in the unit of `height`; see `relative_pose_npt`.

    Seven pairs are solved exactly, so that valid means besides: all rays go down, all seven points lie in the water.
    """
    require_rays("the 7-point solver", 7, index_ratio, layers=layers, rays1=rays1, rays2=rays2)
    require(height, "height", above=0.0)
    layers = over_height(layers, height)
    first, second = bent(rays1, index_ratio, layers), bent(rays2, index_ratio, layers)
    heading, center, valid = _solve(pose_rows(first, second))
    x, y, z = center.unbind(dim=-1)
    below = meet_below(heading, (x, y, z), first, second, layers)
    valid = valid & look_down(rays1, rays2)[..., None] & below
    return heading, _scaled(center, valid, like(height, rays1)), valid


def relative_pose_npt(
    rays1: Rays,
    rays2: Rays,
    index_ratio: Number,
    height: Number = 1.0,
    weights: Float[Tensor, "*batch n"] | None = None,
    *,
    layers: Layers | None = None,
) -> Poses:
    """Linear pose of the second camera from n >= 7 pairs of level rays.

    rays1, rays2: z up, each in its own camera's level frame; height is that of the first camera above the first surface
    and sets the scale; weights: zero for a pair that does not count; layers: between the cameras' medium and the water,
    in the unit of the height. Minimises |E x| with C^2 + S^2 = 1: the last six unknowns leave by QR,
    a 2x2 eigenproblem remains.
    Returns heading in radians, center and valid of the two candidates x and -x, the consistent one first. Valid means:
    determined, second camera above the water. With noise some rays of a right pose meet above the surface or nowhere,
    so that no pair is asked where it meets.
    """
    require_rays("the linear solver", 7, index_ratio, weights, or_more=True, layers=layers, rays1=rays1, rays2=rays2)
    require(height, "height", above=0.0)
    layers = over_height(layers, height)
    rows = pose_rows(bent(rays1, index_ratio, layers), bent(rays2, index_ratio, layers))
    heading, center, valid = _solve(rows if weights is None else rows * weights[..., None])
    return heading, _scaled(center, valid, like(height, rays1)), valid


def pose_rows(first: Slopes, second: Slopes) -> Float[Tensor, "*batch n 8"]:
    """The equations e, for a first camera at height 1."""
    m1, w1, (m2, w2, lift) = first.from_one, first.w, second
    n2, v2 = (torch.stack((part[..., 1], -part[..., 0]), dim=-1) for part in (m2, w2))
    turned = cross2(w2, m1), cross2(v2, m1)
    by_height = cross2(w1, m2), cross2(w1, n2)
    if lift is not None:
        turned = tuple(torch.addcmul(one, lift, other) for one, other in zip(turned, by_height, strict=True))
    return torch.stack((*turned, *by_height, -w2[..., 1], w2[..., 0], w1[..., 1], -w1[..., 0]), dim=-1)


def _solve(rows: Float[Tensor, "*batch n 8"]) -> Poses:
    """Heading, centre and validity of both candidates, for a first camera at height 1."""
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
    center = torch.cat((horizontal, vertical), dim=-1)
    determined = determines(triangle, 6, 2) & (info == 0)
    valid = determined[..., None] & center.isfinite().all(dim=-1) & (center[..., 2] > 0.0)
    return torch.stack((heading, heading + torch.pi), dim=-1), center, valid


def _scaled(
    center: Float[Tensor, "*batch 2 3"], valid: Bool[Tensor, "*batch 2"], height: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch 2 3"]:
    return torch.where(valid[..., None], center * height[..., None, None], 1.0)
