"""From the scores of a sweep to a surface: how well images agree, at which step they do best, planes through that."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

LOWEST = -1.0  # a score of what cannot be seen
REACH = 2  # lattice pixels from the middle of a fitted plane to its end
ROUNDS = 4
SCALE = 0.7  # steps off a plane at which a neighbour counts a quarter
LEAST = 8.0  # neighbours that must agree, of (2 REACH + 1)^2
RIDGE = 1.0  # neighbours at one pixel's distance that say that a plane has no slope
TINY = 1e-6


def box(values: Float[Tensor, "*batch h w"], size: int) -> Float[Tensor, "*batch h-{size}+1 w-{size}+1"]:
    """Means over size x size pixels, where these lie inside."""
    return _sum(_sum(values, size, -2), size, -1) * size**-2.0


def _sum(values: Float[Tensor, "*given"], size: int, dim: int) -> Float[Tensor, "*fewer"]:
    """Of `size` neighbours along a dimension, by doubling: faster than pooling and convolution on CPUs."""
    if size == 1:
        return values
    length = values.shape[dim] - size + 1
    half = _sum(values, size // 2, dim)
    both = half.narrow(dim, 0, length) + half.narrow(dim, size // 2, length)
    return both + values.narrow(dim, size - 1, length) if size % 2 else both


def best_half(
    score: Float[Tensor, "m r c"], usable: Int[Tensor, "r c"], fewest: int, most: int
) -> Float[Tensor, "r c"]:
    """Mean of the better half of each pixel's scores: an image that it is hidden in has no say.

    usable: how many scores mean something; the others are `LOWEST`, and so is the mean of fewer than `fewest`.
    At least `fewest` are averaged, and not more than `most`.
    """
    rest = list(score.unbind(dim=0))
    most = max(most, fewest)
    count = ((usable + 1) // 2).clamp(fewest, most)
    total = torch.zeros_like(rest[0])
    for taken in range(min(len(rest), max((len(rest) + 1) // 2, fewest), most)):
        best = rest.pop()
        for i, other in enumerate(rest):
            best, rest[i] = torch.maximum(best, other), torch.minimum(best, other)
        total += torch.where(taken < count, best, 0.0)
    return torch.where(usable >= fewest, total / count, LOWEST)


class Peaks:
    """The best of the scores (r, c) that come one step after the other, and where between the steps it is.

    Between them by the parabola through a score and its neighbours. At the first and the last step nothing is known of
    one side: a pixel that has its best score there has none.
    """

    def __init__(self, like: Float[Tensor, "r c"]) -> None:
        self.before = self.last = torch.full_like(like, LOWEST)
        self.step, self.score = torch.zeros_like(like), torch.full_like(like, LOWEST)
        self.count = 0

    def add(self, score: Float[Tensor, "r c"]) -> None:
        """Of the next step."""
        higher = (self.last > self.score) & (self.last >= score)
        bend = (2.0 * self.last - self.before - score).clamp_(min=TINY)
        offset = (0.5 * (score - self.before) / bend).clamp_(-0.5, 0.5)
        self.step = torch.where(higher, offset + (self.count - 1), self.step)
        self.score = torch.where(higher, self.last, self.score)
        self.before, self.last = self.last, score
        self.count += 1

    def finish(self) -> tuple[Float[Tensor, "r c"], Float[Tensor, "r c"]]:
        """The best steps and their scores."""
        self.add(torch.full_like(self.last, LOWEST))
        inside = (self.step > 0.5) & (self.step < self.count - 2.5)
        return self.step, torch.where(inside, self.score, LOWEST)


def fit_planes(
    step: Float[Tensor, "r c"], score: Float[Tensor, "r c"]
) -> tuple[Float[Tensor, "3 r c"], Float[Tensor, "r c"]]:
    """Planes step = a + b x + c y around each lattice pixel, as (a, b, c), and mean scores of them.

    step is NaN where there is none. Outliers have little weight (the loss of Geman and McClure, from the median
    of the nearest on); a score is `LOWEST` where too few neighbours agree.
    """
    values = _neighbours(step, math.nan)
    present, size = values.isfinite(), 2 * REACH + 1
    near = torch.arange(size**2, device=step.device).view(size, size)[REACH - 1 : REACH + 2, REACH - 1 : REACH + 2]
    middle = values[near.flatten()].nanmedian(dim=0).values
    values = values.nan_to_num(0.0)
    offset = torch.arange(-REACH, REACH + 1).to(values)
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    moments = torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y)).flatten(1)
    plane = torch.stack((middle, torch.zeros_like(middle), torch.zeros_like(middle)))
    for _ in range(ROUNDS):
        off = (values - moments[:3].T @ plane) / SCALE
        weight = torch.where(present, (1.0 + off.square()).square().reciprocal(), 0.0)
        plane = _least_squares(moments @ weight, moments[:3] @ (weight * values))
    total = weight.sum(dim=0)
    mean_score = (weight * _neighbours(score, LOWEST)).sum(dim=0) / total
    agrees = (total >= LEAST) & middle.isfinite()
    return plane.view(3, *step.shape), torch.where(agrees, mean_score, LOWEST).view(step.shape)


def _neighbours(values: Float[Tensor, "r c"], fill: float) -> Float[Tensor, "around r*c"]:
    """Values around each pixel, itself in the middle: (2 REACH + 1)^2 of them."""
    padded = torch.nn.functional.pad(values[None, None], (REACH,) * 4, value=fill)
    return torch.nn.functional.unfold(padded, 2 * REACH + 1)[0]


def _least_squares(moments: Float[Tensor, "6 n"], sums: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """(a, b, c) from weighted sums of 1, x, y, x^2, x y, y^2, and of v, v x, v y."""
    total, sx, sy, sxx, sxy, syy = moments
    sv, sxv, syv = sums
    per = total.clamp(min=TINY).reciprocal()
    xx, xy, yy = sxx - sx * sx * per + RIDGE, sxy - sx * sy * per, syy - sy * sy * per + RIDGE
    xv, yv = sxv - sx * sv * per, syv - sy * sv * per
    det = (xx * yy - xy * xy).reciprocal()
    b, c = (yy * xv - xy * yv) * det, (xx * yv - xy * xv) * det
    return torch.stack(((sv - b * sx - c * sy) * per, b, c))
