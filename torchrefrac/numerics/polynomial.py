"""Roots of batches of small polynomials as eigenvalues of their companion matrices."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def real_roots(
    coefficients: Float[Tensor, "*batch terms"], tolerance: float | None = None
) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch n"]]:
    """All roots of `coefficients[0] x^n + ... + coefficients[n]`, and which of them are real.

    coefficients: the n + 1 of each polynomial, highest power first, the first one not zero.
    Returns the real parts and a mask; a root counts as real when its imaginary part is
    below `tolerance` times max(1, |root|) (default: 64 square roots of the machine epsilon, which still
    admits the double roots that rounding has split into a conjugate pair).
    """
    monic = coefficients[..., 1:] / coefficients[..., :1]
    degree = monic.shape[-1]
    companion = torch.diag_embed(monic.new_ones(*monic.shape[:-1], degree - 1), offset=-1)
    companion[..., 0, :] = -monic
    roots = torch.linalg.eigvals(companion)
    if tolerance is None:
        tolerance = 64.0 * torch.finfo(monic.dtype).eps ** 0.5
    is_real = roots.imag.abs() <= tolerance * roots.abs().clamp(min=1.0)
    return roots.real, is_real
