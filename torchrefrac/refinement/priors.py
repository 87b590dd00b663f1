"""What is known of a pose beside its pixels: gravity, the heading, and that a camera stands above the water.

Models are rows (tilts, heading, centre) with two tilts a camera, the centre being that of the last camera.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.optim import Quadratic


def with_priors(
    models: Float[Tensor, "k d"], quadratic: Quadratic, gravity_sigma: float, pixel_sigma: float, known_heading: bool
) -> Quadratic:
    """The cost of models in squared pixels with gravity as a prior on the tilts.

    gravity_sigma 0 fixes the tilts, known_heading the heading: their part of the quadratic model becomes the identity.
    A camera below the water costs infinitely much.
    """
    cost, gradient, hessian = quadratic
    tilts = models.shape[-1] - 4
    weight = _weights(models, gravity_sigma, pixel_sigma)
    if weight is not None:
        gradient, hessian = gradient + weight * models, hessian + torch.diag(weight)
    if known_heading or gravity_sigma == 0.0:
        free = torch.ones_like(models[0])
        free[:tilts] = float(gravity_sigma > 0.0)
        free[tilts] = float(not known_heading)
        gradient, hessian = gradient * free, hessian * free[:, None] * free + torch.diag(1.0 - free)
    return Quadratic(cost + prior_costs(models, gravity_sigma, pixel_sigma), gradient, hessian)


def prior_costs(models: Float[Tensor, "k d"], gravity_sigma: float, pixel_sigma: float) -> Float[Tensor, " k"]:
    """What the priors add to the costs of models, in squared pixels, half a sum."""
    weight = _weights(models, gravity_sigma, pixel_sigma)
    tilted = 0.0 if weight is None else 0.5 * (weight * models.square()).sum(dim=-1)
    return torch.where(models[:, -1] > 0.0, tilted, torch.inf)


def _weights(models: Float[Tensor, "k d"], gravity_sigma: float, pixel_sigma: float) -> Float[Tensor, " d"] | None:
    """Of the squares of the unknowns: those of the tilts. None where gravity is exact or unknown."""
    if not 0.0 < gravity_sigma < float("inf"):
        return None
    weight = torch.zeros_like(models[0])
    weight[: models.shape[-1] - 4] = (pixel_sigma / gravity_sigma) ** 2
    return weight
