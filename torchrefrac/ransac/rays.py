"""What both pose estimators do with image coordinates before anything else."""

import torch
from torch import Tensor

from torchrefrac.checks import require

TILT_PX = 20.0


def level_rays(plane: Tensor, cam_from_level: Tensor) -> Tensor:
    """Gravity-aligned rays (N, 3) of image-plane coordinates (N, 2)."""
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ cam_from_level


def tilted_samples(gravity_sigma: float, focal: Tensor) -> float:
    """How many samples without outliers it takes for one that survives the error of the vertical.

    Measured: near one while the vertical is good to 10 pixels, and growing with the square of its error from there.
    """
    return 1.0 + (gravity_sigma * float(focal.mean()) / TILT_PX) ** 2


def require_data(plane: Tensor, **others: Tensor) -> None:
    """Refuse image coordinates that are not (N, 2), what does not belong to as many matches, and NaN."""
    if plane.dim() != 2 or plane.shape[-1] != 2:
        raise ValueError(f"image coordinates have shape {tuple(plane.shape)}, but must be (N, 2)")
    require(plane, "image coordinates")
    for name, value in others.items():
        if len(value) != len(plane):
            raise ValueError(f"{name} has {len(value)} rows, but there are {len(plane)} image coordinates")
        require(value, name)
