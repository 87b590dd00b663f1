"""What both pose estimators do with image coordinates before anything else."""

import torch
from torch import Tensor

from torchrefrac.checks import require


def level_rays(plane: Tensor, cam_from_level: Tensor) -> Tensor:
    """Gravity-aligned rays (*B, N, 3) of image-plane coordinates (*B, N, 2), cam_from_level (*B, 3, 3)."""
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ cam_from_level


def require_data(plane: Tensor, **others: Tensor) -> None:
    """Refuse image coordinates that are not (N, 2), what does not belong to as many matches, and NaN."""
    if plane.dim() != 2 or plane.shape[-1] != 2:
        raise ValueError(f"image coordinates have shape {tuple(plane.shape)}, but must be (N, 2)")
    require(plane, "image coordinates")
    for name, value in others.items():
        if len(value) != len(plane):
            raise ValueError(f"{name} has {len(value)} rows, but there are {len(plane)} image coordinates")
        require(value, name)
