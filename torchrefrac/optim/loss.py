"""Robust losses rho(s) of a squared residual norm s, and the weights rho'(s) of iteratively reweighted squares."""

import torch
from torch import Tensor


def huber(s: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Huber: s inside |r| <= scale, linear in |r| outside."""
    limit = scale * scale
    root = s.clamp(min=limit).sqrt()
    outside = s > limit
    return torch.where(outside, 2.0 * scale * root - limit, s), torch.where(outside, scale / root, 1.0)
