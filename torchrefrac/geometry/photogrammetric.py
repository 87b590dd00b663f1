"""Omega, phi and kappa: the angles by which photogrammetry says how a camera is turned.

world_from_image = Rx(omega) Ry(phi) Rz(kappa), each a turn of coordinates to the right-handed sense about its axis; the
axes of an image are x right, y up and z backward. With all three zero a camera looks straight down, the top of its
image to the north.
"""

import torch
from jaxtyping import Float
from torch import Tensor

LEVEL = 1e-12  # cosine of phi below which omega and kappa turn about the same axis


def rotation_of_angles(angles: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """`cam_from_world` (x right, y down, z forward) of omega, phi and kappa in radians."""
    (so, sp, sk), (co, cp, ck) = angles.sin().unbind(dim=-1), angles.cos().unbind(dim=-1)
    right = (cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck)
    up = (-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk)
    back = (sp, -so * cp, co * cp)
    rows = (*right, *(-part for part in up), *(-part for part in back))
    return torch.stack(rows, dim=-1).reshape(*angles.shape, 3)


def angles_of_rotation(cam_from_world: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Omega, phi in [-pi/2, pi/2] and kappa of `cam_from_world`, radians; omega is 0 where phi is a right angle."""
    right, down, forward = cam_from_world.unbind(dim=-2)
    cosine = torch.hypot(right[..., 0], down[..., 0])
    level = cosine > LEVEL
    phi = torch.atan2(-forward[..., 0], cosine)
    omega = torch.where(level, torch.atan2(forward[..., 1], -forward[..., 2]), 0.0)
    kappa = torch.where(level, torch.atan2(down[..., 0], right[..., 0]), torch.atan2(right[..., 1], -down[..., 1]))
    return torch.stack((omega, phi, kappa), dim=-1)
