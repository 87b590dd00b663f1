"""Robust losses rho(s) of a squared residual norm s, and the weights rho'(s) of iteratively reweighted least squares.

The Gauss-Newton matrix takes these weights alone. Triggs' correction (Triggs et al., "Bundle adjustment - a modern
synthesis", 2000, section 4.3) would add the rank-one term of rho'', which is negative where these losses bend: it takes
away the positive definiteness that a Cholesky factorisation stands on, and near the minimum gains next to nothing.
"""

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

LossName = Literal["squared", "huber", "cauchy", "truncated"]


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
