"""Brown-Conrady lens distortion with OpenCV's five coefficients k1, k2, p1, p2, k3."""

import torch
from torch import Tensor

UNDISTORT_STEPS = 8


def distort(xy: Tensor, coefficients: Tensor) -> Tensor:
    """Distorted image-plane coordinates (*B, 2) of ideal ones (*B, 2); coefficients (*B, 5)."""
    x, y = xy.unbind(dim=-1)
    k1, k2, p1, p2, k3 = coefficients.unbind(dim=-1)
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xy2 = 2.0 * x * y
    return torch.stack(
        (
            x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x),
            y * radial + p2 * xy2 + p1 * (r2 + 2.0 * y * y),
        ),
        dim=-1,
    )


def distort_with_jacobians(xy: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`distort`, its derivative in xy (*B, 2, 2) and in the coefficients (*B, 2, 5)."""
    x, y = xy.unbind(dim=-1)
    k1, k2, p1, p2, k3 = coefficients.unbind(dim=-1)
    r2 = x * x + y * y
    r4 = r2 * r2
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    xy2, x2, y2 = 2.0 * x * y, r2 + 2.0 * x * x, r2 + 2.0 * y * y
    u = x * radial + p1 * xy2 + p2 * x2
    v = y * radial + p2 * xy2 + p1 * y2
    du_dx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    mixed = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    dv_dy = radial + y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y
    by_xy = torch.stack((du_dx, mixed, mixed, dv_dy), dim=-1).reshape(*u.shape, 2, 2)
    by_u = torch.stack((x * r2, x * r4, xy2, x2, x * r4 * r2), dim=-1)
    by_v = torch.stack((y * r2, y * r4, y2, xy2, y * r4 * r2), dim=-1)
    return torch.stack((u, v), dim=-1), by_xy, torch.stack((by_u, by_v), dim=-2)


def undistort(distorted: Tensor, coefficients: Tensor) -> Tensor:
    """Ideal coordinates (*B, 2) whose distortion is `distorted` (*B, 2); inverse of `distort`.

    Newton from the distorted point. It needs a lens that is one-to-one over the image (true of any calibrated
    lens inside its image). The last step carries the graph, so first derivatives are exact.
    """
    target, constants = distorted.detach(), coefficients.detach()
    xy = torch.broadcast_tensors(target, constants[..., :1])[0]
    for _ in range(UNDISTORT_STEPS):
        value, jacobian, _ = distort_with_jacobians(xy, constants)
        xy = xy - _solve_2x2(jacobian, value - target)
    jacobian = distort_with_jacobians(xy, constants)[1]
    return xy - _solve_2x2(jacobian, distort(xy, coefficients) - distorted)


def _solve_2x2(matrix: Tensor, rhs: Tensor) -> Tensor:
    a, b, c, d = matrix.flatten(-2).unbind(dim=-1)
    u, v = rhs.unbind(dim=-1)
    return torch.stack((d * u - b * v, a * v - c * u), dim=-1) / (a * d - b * c)[..., None]
