"""How well two images go together: by the angle at which their rays meet."""

import torch
from torch import Tensor

from torchrefrac.dense.options import DenseOptions

MIN_ANGLE = 1.0  # degrees; below, two images say nothing about distance


def angle_between(first: Tensor, second: Tensor, points: Tensor) -> Tensor:
    """Degrees (*B) between the straight lines from points (*B, 3) to two centres (*B, 3)."""
    a, b = (torch.nn.functional.normalize(center - points, dim=-1) for center in (first, second))
    return torch.rad2deg(torch.acos((a * b).sum(dim=-1).clamp(-1.0, 1.0)))


def fitness(angle: Tensor, options: DenseOptions) -> Tensor:
    """1 at the best angle, less to either side, 0 where nothing is to be learnt."""
    fits = torch.minimum(angle / options.angle_best, options.angle_best / angle.clamp(min=MIN_ANGLE))
    return torch.where((angle > MIN_ANGLE) & (angle < options.angle_max), fits, 0.0)
