"""What is known of a pose beside its pixels: gravity, the heading, and that a camera stands above the water.

Models are rows (tilts, heading, centre) with two tilts a camera, the centre being that of the last camera.
"""

import torch
from torch import Tensor

from torchrefrac.optim import Quadratic


def with_priors(
    models: Tensor, quadratic: Quadratic, gravity_sigma: float, pixel_sigma: float, known_heading: bool
) -> Quadratic:
    """The cost of models (K, D) in squared pixels with gravity as a prior on the tilts.

    gravity_sigma 0 holds the tilts, known_heading the heading: their part of the quadratic model becomes the identity.
    A camera below the water costs infinitely much.
    """
    cost, gradient, hessian = quadratic
    tilts = models.shape[-1] - 4
    if 0.0 < gravity_sigma < float("inf"):
        weight = torch.zeros_like(models[0])
        weight[:tilts] = (pixel_sigma / gravity_sigma) ** 2
        cost = cost + 0.5 * (weight * models.square()).sum(dim=-1)
        gradient, hessian = gradient + weight * models, hessian + torch.diag(weight)
    if known_heading or gravity_sigma == 0.0:
        free = torch.ones_like(models[0])
        free[:tilts] = float(gravity_sigma > 0.0)
        free[tilts] = float(not known_heading)
        gradient, hessian = gradient * free, hessian * free[:, None] * free + torch.diag(1.0 - free)
    return Quadratic(torch.where(models[:, -1] > 0.0, cost, torch.inf), gradient, hessian)


def with_prior_costs(
    models: Tensor, squares: Tensor, gravity_sigma: float, pixel_sigma: float, known_heading: bool
) -> Tensor:
    """Sums of squares (K), and twice what the priors cost."""
    none = models.new_zeros(models.shape)
    flat = Quadratic(0.5 * squares, none, torch.diag_embed(none))
    return 2.0 * with_priors(models, flat, gravity_sigma, pixel_sigma, known_heading).cost
