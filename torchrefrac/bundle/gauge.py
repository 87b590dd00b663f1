"""The directions in which cameras can move with the scene without any image noticing."""

import torch
from torch import Tensor


def gauge_directions(rotation: Tensor, center: Tensor, num_shared: int, refractive: bool) -> Tensor:
    """Orthonormal basis (6m + num_shared, k) of the gauge in camera unknowns (w, dc): R <- exp([w]x) R, c <- c + dc.

    Through a water surface k = 4: shifts in x and y, heading, and scale about the plane. Without refraction k = 7: all
    shifts, all rotations, and scale. rotation (m, 3, 3) cam_from_world, center (m, 3).
    """
    axes = torch.eye(3, dtype=center.dtype, device=center.device)
    still = torch.zeros_like(center)
    shifts = [torch.cat((still, axis.expand_as(center)), dim=-1) for axis in axes]
    turns = [
        torch.cat((-(rotation @ axis), torch.linalg.cross(axis.expand_as(center), center)), dim=-1) for axis in axes
    ]
    if refractive:
        generators = [shifts[0], shifts[1], turns[2], torch.cat((still, center), dim=-1)]
    else:
        generators = [*shifts, *turns, torch.cat((still, center - center.mean(dim=0)), dim=-1)]
    basis = torch.stack([generator.flatten() for generator in generators], dim=-1)
    basis = torch.nn.functional.pad(basis, (0, 0, 0, num_shared))
    return torch.linalg.qr(basis).Q
