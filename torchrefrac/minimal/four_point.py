"""Minimal relative pose of two cameras above one water surface, both with a known vertical: four pairs of rays.

Four unknowns remain: the heading phi and the centre c of the second camera. In the frame of the first one, which stands
at (0, 0, h) with heading 0, the ray of camera k enters the water at q_k = c_k - c_kz m_k and goes on with the slope
w_k = m_k / g_k (see `rays.slopes`), m_2 turned by phi. Two such lines meet where

    (q_1 - q_2) x (w_1 - w_2) = 0        (x: 2D cross product),

which is linear in (c_x, c_y, c_z, 1) with coefficients linear in (1, cos phi, sin phi), behind layers too, where c_kz
stands as c_kz + T_k (see `layers`). Four pairs make a 4x4 matrix M(phi) that must be singular. det M is a trigonometric
polynomial of degree 3, not 4: the terms in exp(i phi) of the first two columns are multiples of each other. Its at most
six roots are headings, and the null vector of M is the centre. Newton steps on the four equations restore the digits
that the determinant has lost.
Degenerate: as in `relative_pose`, and fewer than four different points. Of three headings within 7.5 degrees of each
other two may be missed, which happens in about 2 problems of 10 000.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from torchrefrac.checks import can_be_looked_at, require
from torchrefrac.geometry.triples import Triple
from torchrefrac.minimal.layers import Layers, Number, over_height
from torchrefrac.minimal.rays import Slopes, bent, cross2, look_down, meet_below, require_rays
from torchrefrac.numerics import adjugate_4x4, determinant_4x4, fourier_coefficients, like, roots_on_circle

NEWTON_STEPS = 2
DEGREE = 3
SLOTS = 8
ROUNDING = 16.0
"""Multiple of the machine epsilon below which the four equations count as dependent."""


EightPoses = tuple[Float[Tensor, "*batch 8"], Float[Tensor, "*batch 8 3"], Bool[Tensor, "*batch 8"]]


def relative_pose_4pt(
    rays1: Float[Tensor, "*batch 4 3"],
    rays2: Float[Tensor, "*batch 4 3"],
    index_ratio: Number,
    height: Number = 1.0,
    *,
    layers: Layers | None = None,
) -> EightPoses:
    """Poses of the second camera from 4 pairs of level rays, z up, each in its own camera's level frame.

    height is that of the first camera above the first surface and sets the scale; layers: between the cameras' medium
    and the water, in its unit. Returns heading in radians, center and valid, at most six of them: a real and isolated
    root, the second camera above the water, all rays going down and all four points in the water.
    """
    require_rays("the 4-point solver", 4, index_ratio, layers=layers, rays1=rays1, rays2=rays2)
    require(height, "height", above=0.0)
    return unchecked_relative_pose_4pt(rays1, rays2, index_ratio, height, layers=layers)


def unchecked_relative_pose_4pt(
    rays1: Float[Tensor, "*batch 4 3"],
    rays2: Float[Tensor, "*batch 4 3"],
    index_ratio: Number,
    height: Number = 1.0,
    *,
    layers: Layers | None = None,
) -> EightPoses:
    """`relative_pose_4pt` of arguments that are known to be right."""
    layers = over_height(layers, height)
    first, second = bent(rays1, index_ratio, layers), bent(rays2, index_ratio, layers)
    terms = _terms(first, second)
    samples = torch.arange(2 * DEGREE + 1, dtype=rays1.dtype, device=rays1.device) * (2.0 * torch.pi / (2 * DEGREE + 1))
    heading, is_root = roots_on_circle(fourier_coefficients(determinant_4x4(_turned(terms, samples)[0])))
    center = _null_vector(_turned(terms, heading)[0])
    below = meet_below(heading, center, first, second, layers)
    valid = is_root & look_down(rays1, rays2)[..., None] & below & (center[2] > 0.0)
    heading, center, isolated = _polished(terms, heading, center, valid)
    below = meet_below(heading, center, first, second, layers)
    center = torch.stack(center, dim=-1)
    valid = valid & isolated & below & (center[..., 2] > 0.0) & center.isfinite().all(dim=-1)
    center = torch.where(valid[..., None], center * like(height, rays1)[..., None, None], 1.0)
    none = (0, SLOTS - heading.shape[-1])
    return pad(heading, none), pad(center, (0, 0, *none), value=1.0), pad(valid, none)


def _terms(first: Slopes, second: Slopes) -> Float[Tensor, "3 4 4 *batch 1"]:
    """Coefficients in 1, cos phi, sin phi of the entries of M, for a first camera at height 1."""
    m1, w1, (m2, w2, lift) = first.from_one, first.w, second
    (ax, ay), (px, py) = w1.unbind(dim=-1), w2.unbind(dim=-1)
    zero = torch.zeros_like(ax)
    by_height = cross2(m2, w1), (m2 * w1).sum(dim=-1)
    rest = cross2(m1, w2), -(m1 * w2).sum(dim=-1)
    if lift is not None:
        rest = tuple(torch.addcmul(one, lift, other) for one, other in zip(rest, by_height, strict=True))
    constant = (-ay, ax, zero, zero)
    cosine = (py, -px, by_height[0], rest[0])
    sine = (-px, -py, by_height[1], rest[1])
    columns = torch.stack((*constant, *cosine, *sine)).unflatten(0, (3, 4))
    return columns.movedim(-1, 1)[..., None].contiguous()


def _turned(
    terms: Float[Tensor, "3 4 4 *#batch"], heading: Float[Tensor, "*#batch"]
) -> tuple[Float[Tensor, "4 4 *batch"], Float[Tensor, "4 4 *batch"]]:
    """M and dM/dphi at headings."""
    constant, cosine, sine = terms
    c, s = heading.cos(), heading.sin()
    return torch.addcmul(torch.addcmul(constant, cosine, c), sine, s), torch.addcmul(sine * c, cosine, s, value=-1.0)


def _null_vector(matrix: Float[Tensor, "4 4 *batch"]) -> Triple:
    """The centre with M (c, 1) = 0: the longest column of the adjugate."""
    adjugate = adjugate_4x4(matrix)
    longest = adjugate.square().sum(dim=0).argmax(dim=0)
    x, y, z, w = adjugate.gather(1, longest.expand(4, 1, *longest.shape))[:, 0]
    return x / w, y / w, z / w


def _polished(
    terms: Float[Tensor, "3 4 4 *#batch"],
    heading: Float[Tensor, "*batch"],
    center: Triple,
    wanted: Bool[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Triple, Bool[Tensor, "*batch"]]:
    """Headings and centres after Newton's steps, and where the roots are isolated. Most samples of wrong matches have
    no root that is wanted, and the others may stay as they are."""
    if not can_be_looked_at(heading):
        return _newton_steps(terms, heading, center)
    rows, theirs = wanted.nonzero(as_tuple=True), terms.expand(3, 4, 4, *wanted.shape)[:, :, :, wanted]
    x, y, z = (part[rows] for part in center)
    found, at, is_isolated = _newton_steps(theirs, heading[rows], (x, y, z))
    x, y, z = (whole.index_put(rows, part) for whole, part in zip(center, at, strict=True))
    return heading.index_put(rows, found), (x, y, z), torch.zeros_like(wanted).index_put(rows, is_isolated)


def _newton_steps(
    terms: Float[Tensor, "3 4 4 *#batch"], heading: Float[Tensor, "*#batch"], center: Triple
) -> tuple[Float[Tensor, "*batch"], Triple, Bool[Tensor, "*batch"]]:
    isolated = torch.ones_like(heading, dtype=torch.bool)
    for _ in range(NEWTON_STEPS):
        heading, center, isolated = _newton(terms, heading, center)
    return heading, center, isolated


def _newton(
    terms: Float[Tensor, "3 4 4 *#batch"], heading: Float[Tensor, "*#batch"], center: Triple
) -> tuple[Float[Tensor, "*batch"], Triple, Bool[Tensor, "*batch"]]:
    """One step for (c, phi) on M(phi) (c, 1) = 0, none where it would not be finite, and where the root is isolated."""
    matrix, slope = _turned(terms, heading)
    residual, by_heading = (
        columns[:, 0] * center[0] + columns[:, 1] * center[1] + columns[:, 2] * center[2] + columns[:, 3]
        for columns in (matrix, slope)
    )
    jacobian = torch.stack((matrix[:, 0], matrix[:, 1], matrix[:, 2], by_heading), dim=1)
    determinant = determinant_4x4(jacobian)
    size = jacobian.square().sum(dim=1).prod(dim=0)
    isolated = determinant.square() > (ROUNDING * torch.finfo(determinant.dtype).eps) ** 2 * size
    step = (adjugate_4x4(jacobian) * residual).sum(dim=1) / determinant
    x, y, z, phi = torch.where(step.isfinite().all(dim=0), step, 0.0)
    return heading - phi, (center[0] - x, center[1] - y, center[2] - z), isolated
