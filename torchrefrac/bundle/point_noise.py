"""How noisy the keypoints of each point are: most are precise, a few hardly at all.

The squared residuals of one point say little, because a track has few observations. Empirical Bayes takes the variances
of all points for draws from one distribution, s_0^2 nu / chi^2_nu, whose two parameters follow from all points together
(Smyth, "Linear models and empirical Bayes methods for assessing differential expression", 2004, section 6.2), and
combines them with the residuals of each. Errors over such standard deviations have a variance of one although keypoints
have heavy tails, which one variance for all cannot reach.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

NEGLIGIBLE = 1e-12
NEWTON_STEPS = 30
FEWEST = 20
"""Points that a distribution of variances can be seen by."""
HEAVIEST = 0.5
"""Least degrees of freedom by which a posterior mean of a variance is divided: with less it is not finite."""


def point_variances(
    square: Float[Tensor, " k"], point: Int[Tensor, " k"], count: int, share: float
) -> Float[Tensor, "{count}"]:
    """Variances of a coordinate of the keypoints of each of `count` points.

    square: squared residuals (both coordinates) at a minimum, which points they are of; share: of the numbers measured
    that went into unknowns which points have in common. Each is the mean of what it can be, given the residuals of the
    point and those of the others; all are equal where points are too few to tell them apart, or do not differ.
    """
    total = square.new_zeros(count).index_add_(0, point, square)
    measured = torch.bincount(point, minlength=count).to(square)
    freedom = (2.0 * measured * (1.0 - share) - 3.0).clamp(min=0.0)
    judged = freedom > 0.0
    own = total[judged] / freedom[judged]
    pooled = (total[judged].sum() / freedom[judged].sum().clamp(min=NEGLIGIBLE)).expand(count)
    if int(judged.sum()) < FEWEST:
        return pooled
    typical, prior = _prior(own.clamp(min=NEGLIGIBLE * float(pooled[0]) + torch.finfo(own.dtype).tiny), freedom[judged])
    if prior == torch.inf:
        return pooled
    return (total + prior * typical) / (freedom + prior - 2.0).clamp(min=HEAVIEST)


def _prior(variance: Float[Tensor, " n"], freedom: Float[Tensor, " n"]) -> tuple[float, float]:
    """s_0^2 and nu from sample variances with degrees of freedom: the logarithm of each has the mean
    log s_0^2 + psi(d/2) - log(d/2) - psi(nu/2) + log(nu/2) and the variance psi'(d/2) + psi'(nu/2)."""
    half = 0.5 * freedom
    level = variance.log() - torch.digamma(half) + half.log()
    mean = level.mean()
    excess = float((level - mean).square().mean() - torch.polygamma(1, half).mean())
    if excess <= 0.0:
        return float(mean.exp()), torch.inf
    found = _inverse_trigamma(level.new_tensor(excess))
    return float((mean + torch.digamma(found) - found.log()).exp()), 2.0 * float(found)


def _inverse_trigamma(value: Float[Tensor, ""]) -> Float[Tensor, ""]:
    """x with psi'(x) = value > 0, by Newton's method on 1 / psi', which is convex and nearly linear (Smyth 2004)."""
    x = 0.5 + value.reciprocal()
    for _ in range(NEWTON_STEPS):
        slope = torch.polygamma(1, x)
        x = x + slope * (1.0 - slope / value) / torch.polygamma(2, x)
    return x
