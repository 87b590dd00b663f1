"""What both pose estimators do with image coordinates before anything else."""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.minimal.rays import require_matches


def level_rays(
    plane: Float[Tensor, "*#batch n 2"], cam_from_level: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch n 3"]:
    """Gravity-aligned rays of image-plane coordinates."""
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ cam_from_level


def require_data(plane: Float[Tensor, "n 2"], **others: Shaped[Tensor, "n columns"]) -> None:
    """Refuse what `require_matches` does, and what is not finite."""
    require_matches(plane, **others)
    require(plane, "image coordinates")
    for name, value in others.items():
        require(value, name)
