"""Brown-Conrady lens distortion with OpenCV's five coefficients k1, k2, p1, p2, k3."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry.triples import Part, components
from torchrefrac.numerics import in_blocks

UNDISTORT_STEPS = 8


class DistortionSlopes(NamedTuple):
    """Distorted (u, v) and derivatives: in the ideal (x, y), where dv/dx = du/dy = mixed, and in k1, k2, p1, p2, k3."""

    u: Part
    v: Part
    du_dx: Part
    mixed: Part
    dv_dy: Part
    by_u: tuple[Part, ...]
    by_v: tuple[Part, ...]


def distort(xy: Float[Tensor, "*#batch 2"], coefficients: Float[Tensor, "*#batch 5"]) -> Float[Tensor, "*batch 2"]:
    """Distorted image-plane coordinates of ideal ones."""
    x, y = xy.unbind(dim=-1)
    return torch.stack(distort_components(x, y, coefficients.unbind(dim=-1)), dim=-1)


def distort_with_jacobians(
    xy: Float[Tensor, "*#batch 2"], coefficients: Float[Tensor, "*#batch 5"]
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2 2"], Float[Tensor, "*batch 2 5"]]:
    """`distort`, its derivative in xy and in the coefficients."""
    x, y = xy.unbind(dim=-1)
    k = coefficients.unbind(dim=-1)
    slopes = distortion_slopes(x, y, k)
    u, v = slopes.u, slopes.v
    by_xy = torch.stack((slopes.du_dx, slopes.mixed, slopes.mixed, slopes.dv_dy), dim=-1).unflatten(-1, (2, 2))
    by_k = torch.stack(torch.broadcast_tensors(u, *slopes.by_u, *slopes.by_v)[1:], dim=-1).unflatten(-1, (2, 5))
    return torch.stack((u, v), dim=-1), by_xy, by_k


def distort_components(x: Part, y: Part, coefficients: Sequence[Part]) -> tuple[Part, Part]:
    """`distort` of separate coordinates."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xy2 = 2.0 * x * y
    return (x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x), y * radial + p2 * xy2 + p1 * (r2 + 2.0 * y * y))


def distortion_slopes(x: Part, y: Part, coefficients: Sequence[Part]) -> DistortionSlopes:
    """`distort_components` with its derivatives."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    r4 = r2 * r2
    r6 = r4 * r2
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    xy2, x2, y2 = 2.0 * x * y, r2 + 2.0 * x * x, r2 + 2.0 * y * y
    return DistortionSlopes(
        u=x * radial + p1 * xy2 + p2 * x2,
        v=y * radial + p2 * xy2 + p1 * y2,
        du_dx=radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        mixed=x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
        dv_dy=radial + y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y,
        by_u=(x * r2, x * r4, xy2, x2, x * r6),
        by_v=(y * r2, y * r4, y2, xy2, y * r6),
    )


def undistort(
    distorted: Float[Tensor, "*#batch 2"], coefficients: Float[Tensor, "*#batch 5"]
) -> Float[Tensor, "*batch 2"]:
    """Ideal coordinates whose distortion is `distorted`; inverse of `distort`.

    Newton from the distorted point. It needs a distortion that is one-to-one over the image (true of any calibrated
    camera inside its image). The last step carries the graph, so first derivatives are exact.
    """
    return in_blocks(_undistort, (distorted, coefficients), (1, 1), (1,))[0]


def _undistort(
    distorted: Float[Tensor, "*#batch 2"], coefficients: Float[Tensor, "*#batch 5"]
) -> tuple[Float[Tensor, "*batch 2"]]:
    u, v = components(distorted)
    k = components(coefficients)
    constants = [value.detach() for value in k]
    x, y = u.detach(), v.detach()
    for _ in range(UNDISTORT_STEPS):
        x, y = _newton_step(x, y, constants, constants, u.detach(), v.detach())
    x, y = _newton_step(x, y, constants, k, u, v)
    return (torch.stack((x, y), dim=-1),)


def _newton_step(
    x: Part, y: Part, constants: Sequence[Part], coefficients: Sequence[Part], u: Part, v: Part
) -> tuple[Part, Part]:
    slopes = distortion_slopes(x, y, constants)
    du_dx, mixed, dv_dy = slopes.du_dx, slopes.mixed, slopes.dv_dy
    at_x, at_y = distort_components(x, y, coefficients) if coefficients is not constants else (slopes.u, slopes.v)
    du, dv = at_x - u, at_y - v
    determinant = du_dx * dv_dy - mixed * mixed
    return x - (dv_dy * du - mixed * dv) / determinant, y - (du_dx * dv - mixed * du) / determinant
