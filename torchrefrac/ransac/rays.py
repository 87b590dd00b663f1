"""What both pose estimators do with image coordinates before anything else."""

import torch
from torch import Tensor

from torchrefrac.checks import require

TILT_PX = 20.0
LEAST_LIMIT = 0.05


def level_rays(plane: Tensor, cam_from_level: Tensor) -> Tensor:
    """Gravity-aligned rays (N, 3) of image-plane coordinates (N, 2)."""
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1) @ cam_from_level


def tilted_samples(gravity_sigma: float, focal: Tensor) -> float:
    """How many samples without outliers it takes for one that survives the error of the vertical.

    Measured: near one while the vertical is good to 10 pixels, and growing with the square of its error from there.
    """
    return 1.0 + (gravity_sigma * float(focal.mean()) / TILT_PX) ** 2


def tightened(squared_errors: Tensor, max_error: float) -> float:
    """Three robust standard deviations of the errors within max_error: a limit for the last fit, in pixels.

    A wrong match within max_error weighs as much as many right ones. The standard deviation is 1.4826 times the median
    of what lies within, as for noise without outliers. At most max_error, and at least LEAST_LIMIT.
    """
    within = squared_errors[squared_errors < max_error * max_error]
    if not len(within):
        return max_error
    return min(max_error, max(3.0 * 1.4826 * float(within.median().sqrt()), LEAST_LIMIT))


def require_data(plane: Tensor, **others: Tensor) -> None:
    """Refuse image coordinates that are not (N, 2), what does not belong to as many matches, and NaN."""
    if plane.dim() != 2 or plane.shape[-1] != 2:
        raise ValueError(f"image coordinates have shape {tuple(plane.shape)}, but must be (N, 2)")
    require(plane, "image coordinates")
    for name, value in others.items():
        if len(value) != len(plane):
            raise ValueError(f"{name} has {len(value)} rows, but there are {len(plane)} image coordinates")
        require(value, name)
