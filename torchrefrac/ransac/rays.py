"""What both pose estimators do with image coordinates before anything else."""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.checks import require


def level_rays(
    plane: Float[Tensor, "*#batch n 2"], cam_from_level: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch n 3"]:
    """Gravity-aligned rays of image-plane coordinates."""
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ cam_from_level


def require_data(plane: Float[Tensor, "n 2"], **others: Shaped[Tensor, "n columns"]) -> None:
    """Refuse image coordinates that are not (N, 2), what does not belong to as many matches, and NaN."""
    if plane.dim() != 2 or plane.shape[-1] != 2:
        raise ValueError(f"image coordinates have shape {tuple(plane.shape)}, but must be (N, 2)")
    require(plane, "image coordinates")
    for name, value in others.items():
        if len(value) != len(plane):
            raise ValueError(f"{name} has {len(value)} rows, but there are {len(plane)} image coordinates")
        require(value, name)
