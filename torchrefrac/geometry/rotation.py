"""Rotation matrices and their exponential coordinates."""

import torch
from jaxtyping import Float
from torch import Tensor


def skew(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix [v]x with [v]x w = v x w."""
    x, y, z = v.unbind(dim=-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).reshape(*v.shape, 3)


def rotate(rotation: Float[Tensor, "*#batch 3 3"], v: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Matrix times vector over broadcast batches.

    Multiplied out, not by a matrix product, which autocast would do in half precision and a GPU in TF32.
    """
    x, y, z = v[..., None].unbind(dim=-2)
    return rotation[..., 0] * x + rotation[..., 1] * y + rotation[..., 2] * z


def nearest_rotation(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotations that differ least from matrices by the sum of squares (Schönemann, "A generalized solution of the
    orthogonal Procrustes problem", 1966; with the sign of Kabsch, 1978): the mean of rotations from their sum."""
    u, _, vt = torch.linalg.svd(matrix)
    last = torch.linalg.det(u @ vt).sign()
    sign = torch.stack((torch.ones_like(last), torch.ones_like(last), last), dim=-1)
    return (u * sign[..., None, :]) @ vt


def so3_exp(omega: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation by |omega| radians about omega (Rodrigues), smooth at zero."""
    angle_sq = omega.square().sum(dim=-1)
    small = angle_sq < 1e-8
    safe = torch.where(small, torch.ones_like(angle_sq), angle_sq)
    angle = safe.sqrt()
    a = torch.where(small, 1.0 - angle_sq / 6.0, angle.sin() / angle)[..., None, None]
    b = torch.where(small, 0.5 - angle_sq / 24.0, (1.0 - angle.cos()) / safe)[..., None, None]
    identity = torch.eye(3, dtype=omega.dtype, device=omega.device)
    outer = omega[..., :, None] * omega[..., None, :]
    return identity + a * skew(omega) + b * (outer - angle_sq[..., None, None] * identity)


def so3_log(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vector of angle in [0, pi] (radians).

    Goes through the unit quaternion of the largest component, so it is accurate near zero and near pi.
    """
    w_xyz = quaternion_of(rotation)
    w_xyz = torch.where(w_xyz[..., :1] < 0.0, -w_xyz, w_xyz)
    w, xyz = w_xyz[..., :1], w_xyz[..., 1:]
    sine = xyz.norm(dim=-1, keepdim=True)
    tiny = sine < 1e-12
    scale = torch.where(tiny, 2.0, 2.0 * torch.atan2(sine, w) / torch.where(tiny, 1.0, sine))
    return scale * xyz


def quaternion_of(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion wxyz, read off the row of q q^T with the largest diagonal."""
    r = rotation
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    xx, yy, zz = (1.0 + 2.0 * r[..., i, i] - trace for i in range(3))
    wx, wy, wz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    entries = (1.0 + trace, wx, wy, wz, wx, xx, xy, xz, wy, xy, yy, yz, wz, xz, yz, zz)
    outer = torch.stack(entries, dim=-1).reshape(*trace.shape, 4, 4)
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    row = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    return row / row.norm(dim=-1, keepdim=True)
