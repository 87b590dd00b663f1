"""Robust losses rho(s) of a squared residual norm s, and the weights rho'(s) of iteratively reweighted least squares.

Reweighted alone, a step towards the minimum is too short in the direction of a residual that the loss bends for, where
the cost is curved less than a weighted square: see `turned`.
"""

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

LossName = Literal["squared", "huber", "cauchy", "truncated"]
BENDING: tuple[LossName, ...] = ("huber", "cauchy")
"""Those whose weights change with the residual."""
LEAST_CURVATURE = 0.5
"""Times the weight: what the Gauss-Newton matrix has along a residual, at least. Less gives longer steps near the
minimum, more of which are dropped on the way there."""


def robust(
    s: Float[Tensor, "*batch"], loss: LossName, scale: float
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """rho and its derivative at squared norms s; `scale` is in the unit of the residual.

    squared: s itself. huber: linear in |r| beyond the scale. cauchy: scale^2 log(1 + s / scale^2). truncated: constant
    beyond the scale.
    """
    if loss == "squared":
        return s, torch.ones_like(s)
    if loss == "huber":
        return huber(s, scale)
    limit = scale * scale
    if loss == "cauchy":
        return limit * torch.log1p(s / limit), (1.0 + s / limit).reciprocal()
    if loss == "truncated":
        return s.clamp(max=limit), (s <= limit).to(s.dtype)
    raise ValueError(f"loss is {loss!r}, but must be one of {', '.join(get_args(LossName))}")


def huber(s: Float[Tensor, "*batch"], scale: float) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Huber: s inside |r| <= scale, linear in |r| outside."""
    limit = scale * scale
    root = s.clamp(min=limit).sqrt()
    outside = s > limit
    return torch.where(outside, 2.0 * scale * root - limit, s), torch.where(outside, scale / root, 1.0)


def radial_curvature(weight: Float[Tensor, "*batch"], loss: LossName) -> Float[Tensor, "*batch"]:
    """Half the second derivative of rho along the residual, rho' + 2 s rho'', by rho' = weight; across it is rho'."""
    if loss == "huber":
        return torch.where(weight < 1.0, 0.0, weight)
    return weight * (2.0 * weight - 1.0) if loss == "cauchy" else weight


def turned(
    residual: tuple[Float[Tensor, " k"], Float[Tensor, " k"]], weight: Float[Tensor, " k"], loss: LossName
) -> tuple[Float[Tensor, " k"], Float[Tensor, " k"]]:
    """Triggs' correction of residuals of two components (Triggs et al., "Bundle adjustment - a modern synthesis", 2000,
    section 4.3), as far as the Gauss-Newton matrix stays positive definite.

    In the place of derivatives J and the residual r stand (I - a r r') J and (I - a r r') b r, before all have the root
    of the weight; a and b, by which the gradient stays as it is.
    """
    share = (radial_curvature(weight, loss) / weight).clamp(min=LEAST_CURVATURE)
    square = torch.addcmul(residual[0] * residual[0], residual[1], residual[1])
    return (1.0 - share.sqrt()) / square.clamp(min=torch.finfo(square.dtype).tiny), share.reciprocal()
