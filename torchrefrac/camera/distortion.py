"""Lens distortion: OpenCV's five or eight coefficients, or those of its fisheye model; a batch may have both.

Without coefficients there is no distortion, and nothing is computed. `fisheye` says of which elements of a batch the
coefficients are those of the fisheye model (the first four count); None: of none.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera.fisheye import fisheye as fisheye_model
from torchrefrac.camera.fisheye import fisheye_slopes, without_fisheye
from torchrefrac.camera.rational import DistortionSlopes, rational, rational_slopes
from torchrefrac.geometry.triples import Mask, Part, components
from torchrefrac.numerics import in_blocks

UNDISTORT_STEPS = 8


def distort(
    xy: Float[Tensor, "*#batch 2"],
    coefficients: Float[Tensor, "*#batch k"],
    fisheye: Bool[Tensor, "*#batch"] | None = None,
) -> Float[Tensor, "*batch 2"]:
    """Distorted image-plane coordinates of ideal ones."""
    x, y = xy.unbind(dim=-1)
    return torch.stack(distort_components(x, y, coefficients.unbind(dim=-1), fisheye), dim=-1)


def distort_with_jacobians(
    xy: Float[Tensor, "*#batch 2"],
    coefficients: Float[Tensor, "*#batch k"],
    fisheye: Bool[Tensor, "*#batch"] | None = None,
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2 2"], Float[Tensor, "*batch 2 k"]]:
    """`distort`, its derivative in xy and in the coefficients."""
    x, y = xy.unbind(dim=-1)
    k = coefficients.unbind(dim=-1)
    slopes = distortion_slopes(x, y, k, fisheye)
    u, v = slopes.u, slopes.v
    by_xy = torch.stack((slopes.du_dx, slopes.mixed, slopes.mixed, slopes.dv_dy), dim=-1).unflatten(-1, (2, 2))
    if not k:
        return torch.stack((u, v), dim=-1), by_xy, by_xy[..., :0]
    by_k = torch.stack(torch.broadcast_tensors(u, *slopes.by_u, *slopes.by_v)[1:], dim=-1).unflatten(-1, (2, len(k)))
    return torch.stack((u, v), dim=-1), by_xy, by_k


def distort_components(
    x: Part, y: Part, coefficients: Sequence[Part], fisheye: Mask | None = None
) -> tuple[Part, Part]:
    """`distort` of separate coordinates."""
    if not coefficients:
        return x, y
    if fisheye is None:
        return rational(x, y, coefficients)
    plain = rational(*_where(~fisheye, x, y), coefficients)
    wide = fisheye_model(*_where(fisheye, x, y), coefficients)
    return torch.where(fisheye, wide[0], plain[0]), torch.where(fisheye, wide[1], plain[1])


def distortion_slopes(x: Part, y: Part, coefficients: Sequence[Part], fisheye: Mask | None = None) -> DistortionSlopes:
    """`distort_components` with its derivatives."""
    if not coefficients:
        one, zero = torch.ones_like(x), torch.zeros_like(x)
        return DistortionSlopes(x, y, one, zero, one, (), ())
    if fisheye is None:
        return rational_slopes(x, y, coefficients)
    plain = rational_slopes(*_where(~fisheye, x, y), coefficients)
    wide = fisheye_slopes(*_where(fisheye, x, y), coefficients)

    def chosen(one: Part, other: Part) -> Part:
        return torch.where(fisheye, one, other)

    return DistortionSlopes(
        *map(chosen, wide[:5], plain[:5]),
        by_u=tuple(map(chosen, wide.by_u, plain.by_u)),
        by_v=tuple(map(chosen, wide.by_v, plain.by_v)),
    )


def undistort(
    distorted: Float[Tensor, "*#batch 2"],
    coefficients: Float[Tensor, "*#batch k"],
    fisheye: Bool[Tensor, "*#batch"] | None = None,
) -> Float[Tensor, "*batch 2"]:
    """Ideal coordinates whose distortion is `distorted`; inverse of `distort`.

    Newton from the distorted point, of fisheyes in the angle. It needs a distortion that is one-to-one over the image
    (true of any calibrated camera inside its image). The last step carries the graph, so first derivatives are exact.
    """
    if not coefficients.shape[-1]:
        batch = torch.broadcast_shapes(distorted.shape[:-1], coefficients.shape[:-1])
        return distorted.expand((*batch, 2)).contiguous()
    if fisheye is None:
        return in_blocks(_undistort, (distorted, coefficients), (1, 1), (1,))[0]
    return in_blocks(_undistort, (distorted, coefficients, fisheye), (1, 1, 0), (1,))[0]


def _undistort(
    distorted: Float[Tensor, "*#batch 2"],
    coefficients: Float[Tensor, "*#batch k"],
    fisheye: Bool[Tensor, "*#batch"] | None = None,
) -> tuple[Float[Tensor, "*batch 2"]]:
    u, v = components(distorted)
    k = components(coefficients)
    constants = [value.detach() for value in k]
    x, y = _nearly_ideal(u.detach(), v.detach(), constants, fisheye)
    x, y = _newton_step(x, y, constants, k, u, v, fisheye)
    return (torch.stack((x, y), dim=-1),)


def _nearly_ideal(u: Part, v: Part, constants: Sequence[Part], fisheye: Mask | None) -> tuple[Part, Part]:
    """All steps but the last."""
    if fisheye is not None:
        wide = without_fisheye(*_where(fisheye, u, v), constants)
        plain = _nearly_ideal(*_where(~fisheye, u, v), constants, None)
        return torch.where(fisheye, wide[0], plain[0]), torch.where(fisheye, wide[1], plain[1])
    x, y = u, v
    for _ in range(UNDISTORT_STEPS):
        x, y = _newton_step(x, y, constants, constants, u, v)
    return x, y


def _newton_step(
    x: Part,
    y: Part,
    constants: Sequence[Part],
    coefficients: Sequence[Part],
    u: Part,
    v: Part,
    fisheye: Mask | None = None,
) -> tuple[Part, Part]:
    slopes = distortion_slopes(x, y, constants, fisheye)
    du_dx, mixed, dv_dy = slopes.du_dx, slopes.mixed, slopes.dv_dy
    at_x, at_y = (slopes.u, slopes.v)
    if coefficients is not constants:
        at_x, at_y = distort_components(x, y, coefficients, fisheye)
    du, dv = at_x - u, at_y - v
    determinant = du_dx * dv_dy - mixed * mixed
    return x - (dv_dy * du - mixed * dv) / determinant, y - (du_dx * dv - mixed * du) / determinant


def _where(mask: Mask, x: Part, y: Part) -> tuple[Part, Part]:
    """Coordinates where they are meant, the middle of the image elsewhere: nothing overflows there."""
    return torch.where(mask, x, 0.0), torch.where(mask, y, 0.0)
