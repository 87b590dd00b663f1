"""Minimal relative pose of two cameras above one water surface, both with a known vertical: four pairs of rays.

Four unknowns remain: the heading phi and the centre c of the second camera. In the frame of the first one, which stands
at (0, 0, h) with heading 0, the ray of camera k enters the water at q_k = c_k - c_kz m_k and goes on with the slope
w_k = m_k / g_k (see `rays.slopes`), m_2 turned by phi. Two such lines meet where

    (q_1 - q_2) x (w_1 - w_2) = 0        (x: 2D cross product),

which is linear in (c_x, c_y, c_z, 1) with coefficients linear in (1, cos phi, sin phi). Four pairs make a 4x4 matrix
M(phi) that must be singular. det M is a trigonometric polynomial of degree 3, not 4: the terms in exp(i phi) of the first
two columns are multiples of each other. Its at most six roots are headings, and the null vector of M is the centre. Newton steps on the four equations restore the digits that the determinant has lost.
Degenerate: as in `relative_pose`.
"""

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrefrac.geometry.triples import Triple
from torchrefrac.minimal.rays import cross2, require_pairs, slopes
from torchrefrac.numerics import adjugate_4x4, determinant_4x4, fourier_coefficients, like, roots_on_circle

NEWTON_STEPS = 2
DEGREE = 3
SLOTS = 8

Rays = tuple[Tensor, Tensor]
"""Slopes m in air and w in the water (*B, 4, 2)."""


def relative_pose_4pt(
    rays1: Tensor, rays2: Tensor, index_ratio: Tensor | float, height: Tensor | float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Poses of the second camera from 4 pairs of level rays (*B, 4, 3), z up, each in its own camera's level frame.

    height (*B) or a number is that of the first camera and sets the scale. Returns heading (*B, 8) in radians,
    center (*B, 8, 3) and valid (*B, 8): a real root, the second camera above the water, all four points below it.
    Raises ValueError for rays of another shape.
    """
    require_pairs(rays1, rays2, 4, "4-point solver")
    index, scale = like(index_ratio, rays1)[..., None], like(height, rays1)[..., None, None]
    m1, g1 = slopes(rays1, index)
    m2, g2 = slopes(rays2, index)
    w1, w2 = m1 / g1[..., None], m2 / g2[..., None]
    terms = _terms(m1, w1, m2, w2)
    samples = torch.arange(2 * DEGREE + 1, dtype=m1.dtype, device=m1.device) * (2.0 * torch.pi / (2 * DEGREE + 1))
    heading, is_root = roots_on_circle(fourier_coefficients(determinant_4x4(_turned(terms, samples)[0])))
    center = _null_vector(_turned(terms, heading)[0])
    for _ in range(NEWTON_STEPS):
        heading, center = _newton(terms, heading, center)
    down = ((rays1[..., 2] < 0.0) & (rays2[..., 2] < 0.0)).all(dim=-1)
    below = _meet_below(heading, center, (m1, w1), (m2, w2))
    center = torch.stack(center, dim=-1)
    valid = is_root & down[..., None] & below & (center[..., 2] > 0.0) & center.isfinite().all(dim=-1)
    center = torch.where(valid[..., None], center, 1.0) * scale
    none = (0, SLOTS - heading.shape[-1])
    return pad(heading, none), pad(center, (0, 0, *none), value=1.0), pad(valid, none)


def _terms(m1: Tensor, w1: Tensor, m2: Tensor, w2: Tensor) -> Tensor:
    """Coefficients (3, 4, 4, *B, 1) in 1, cos phi, sin phi of the entries of M, for a first camera at height 1."""
    (ax, ay), (px, py) = w1.unbind(dim=-1), w2.unbind(dim=-1)
    zero = torch.zeros_like(ax)
    constant = (-ay, ax, zero, zero)
    cosine = (py, -px, cross2(m2, w1), cross2(m1, w2))
    sine = (-px, -py, (m2 * w1).sum(dim=-1), -(m1 * w2).sum(dim=-1))
    columns = torch.stack((*constant, *cosine, *sine)).unflatten(0, (3, 4))
    return columns.movedim(-1, 1)[..., None].contiguous()


def _turned(terms: Tensor, heading: Tensor) -> tuple[Tensor, Tensor]:
    """M and dM/dphi (4, 4, *B, R) at headings (*B, R)."""
    constant, cosine, sine = terms
    c, s = heading.cos(), heading.sin()
    return torch.addcmul(torch.addcmul(constant, cosine, c), sine, s), torch.addcmul(sine * c, cosine, s, value=-1.0)


def _null_vector(matrix: Tensor) -> Triple:
    """The centre (*B) with M (c, 1) = 0: the longest column of the adjugate."""
    adjugate = adjugate_4x4(matrix)
    longest = adjugate.square().sum(dim=0).argmax(dim=0)
    x, y, z, w = adjugate.gather(1, longest.expand(4, 1, *longest.shape))[:, 0]
    return x / w, y / w, z / w


def _newton(terms: Tensor, heading: Tensor, center: Triple) -> tuple[Tensor, Triple]:
    """One step for (c, phi) on M(phi) (c, 1) = 0; none where it would not be finite."""
    matrix, slope = _turned(terms, heading)
    residual, by_heading = (
        columns[:, 0] * center[0] + columns[:, 1] * center[1] + columns[:, 2] * center[2] + columns[:, 3]
        for columns in (matrix, slope)
    )
    jacobian = torch.stack((matrix[:, 0], matrix[:, 1], matrix[:, 2], by_heading), dim=1)
    step = (adjugate_4x4(jacobian) * residual).sum(dim=1) / determinant_4x4(jacobian)
    x, y, z, phi = torch.where(step.isfinite().all(dim=0), step, 0.0)
    return heading - phi, (center[0] - x, center[1] - y, center[2] - z)


def _meet_below(heading: Tensor, center: Triple, first: Rays, second: Rays) -> Tensor:
    """Whether all rays meet below the surface (*B, R): at the depth (q1 - q2) . (w1 - w2) / |w1 - w2|^2."""
    c, s = heading.cos()[..., None, :], heading.sin()[..., None, :]
    (m1x, m1y), (w1x, w1y) = (part[..., None, :].unbind(dim=-1) for part in first)
    (m2x, m2y), (w2x, w2y) = (part[..., None, :].unbind(dim=-1) for part in second)
    x, y, z = (part[..., None, :] for part in center)
    along_x = (z * (c * m2x + s * m2y) - x - m1x) * (w1x - c * w2x - s * w2y)
    along_y = (z * (c * m2y - s * m2x) - y - m1y) * (w1y - c * w2y + s * w2x)
    return (along_x + along_y > 0.0).all(dim=-2)
