"""Alignments of corresponding points, some of which may be wrong: the full similarity, and the one that leaves the
vertical alone."""

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from torchrefrac.geometry.alignment import Similarity, align_similarity, similarity_parts
from torchrefrac.geometry.gravity import heading_rotation
from torchrefrac.numerics import thin

TRIED = 2000
OUTLYING = 5.0
"""Median errors beyond which a point takes no part in the alignment."""
MOST_IN_TURN = 24
"""Points of which every three are tried; of more, TRIED threes by chance."""


def robust_similarity(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], sigma: Float[Tensor, " n"]
) -> tuple[Similarity, Bool[Tensor, " n"]]:
    """The 7-dof similarity that maps `source` onto `target`, whose points have errors of `sigma` along each axis, by
    those that agree with the similarity of three which has the least median error; and which these are.

    Points on a line leave the turn about it open.
    """
    chosen = _threes(len(source))
    thirds = source[chosen], target[chosen]
    scale, rotation, translation = similarity_parts(*thirds, torch.ones_like(thirds[0][..., 0]))
    moved = scale[:, None, None] * source @ rotation.mT + translation[:, None]
    error = (moved - target).norm(dim=-1) / sigma
    accepted = _agreeing(error, 3)
    weight = torch.where(accepted, 1.0 / sigma.square(), 0.0)
    return align_similarity(source, target, weight), accepted


def robust_level_similarity(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], sigma: Float[Tensor, " n"]
) -> tuple[Similarity, Bool[Tensor, " n"]]:
    """The 5-dof similarity (heading, scale, shift) of `source` onto `target`, which both have z up, and whose points
    have horizontal errors of `sigma`, by those that agree with the horizontal similarity of two which has
    the least median error; and which these are. Heading, scale and place follow from them horizontally, the height from
    the mean."""
    ours, theirs = (torch.complex(at[:, 0], at[:, 1]) for at in (source, target))
    first, second = torch.triu_indices(len(ours), len(ours), 1)
    some = thin(torch.arange(len(first)), TRIED)
    first, second = first[some], second[some]
    factor = (theirs[second] - theirs[first]) / (ours[second] - ours[first])
    error = (theirs - factor[:, None] * ours - (theirs[first] - factor * ours[first])[:, None]).abs() / sigma
    accepted = _agreeing(error, 2)
    weight = torch.where(accepted, 1.0 / sigma.square(), 0.0)
    factor, shift = _horizontal(ours, theirs, weight)
    scale = factor.abs()
    lift = (target[accepted, 2] - scale * source[accepted, 2]).mean()
    return Similarity(scale, heading_rotation(factor.angle()), torch.stack((shift.real, shift.imag, lift))), accepted


def are_on_a_line(points: Float[Tensor, "n 3"], width: float | Float[Tensor, ""]) -> bool:
    """Whether points lie within `width` (root mean square) of a line, or all in one place."""
    across = torch.linalg.svdvals(points - points.mean(dim=0))[1:2] / len(points) ** 0.5
    return not bool((across > width).all() & (len(points) >= 3))


def _threes(count: int) -> Int[Tensor, "k 3"]:
    """Threes of so many points."""
    if count <= MOST_IN_TURN:
        return torch.combinations(torch.arange(count), 3)
    draw = torch.Generator().manual_seed(0)
    return torch.rand(TRIED, count, generator=draw).topk(3, dim=1).indices


def _agreeing(error: Float[Tensor, "k n"], chosen: int) -> Bool[Tensor, " n"]:
    """Which points agree with the one of k alignments, each through `chosen` of them, that has the least median error,
    or error of the first that was not chosen."""
    n = error.shape[1]
    rank = min(max((n + 1) // 2, chosen + 1), n)
    typical = error.nan_to_num(torch.inf).kthvalue(rank, dim=1).values
    best = typical.argmin()
    return error[best] <= OUTLYING * torch.maximum(typical[best], torch.ones_like(typical[best]))


def _horizontal(
    ours: Complex[Tensor, " k"], theirs: Complex[Tensor, " k"], weight: Float[Tensor, " k"]
) -> tuple[Complex[Tensor, ""], Complex[Tensor, ""]]:
    """theirs = factor ours + shift, by least squares."""
    middle, goal = ((weight * at).sum() / weight.sum() for at in (ours, theirs))
    a, b = ours - middle, theirs - goal
    factor = (weight * a.conj() * b).sum() / (weight * a.abs().square()).sum()
    return factor, goal - factor * middle
