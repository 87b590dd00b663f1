"""Which pairs of photographs to match: masks of pairs, symmetric, by the order of names or by a score of each pair."""

import re
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.numerics import components

NUMBERED = 0.8
"""Share of the steps from one name to the next that are equal where names show an order."""
LAST_NUMBER = re.compile(r"(.*?)(\d+)(\D*)")
DIGITS = 20  # as many as numbers in names of files have at most


def every_pair(count: int) -> Bool[Tensor, "{count} {count}"]:
    """All pairs of so many images."""
    return ~torch.eye(count, dtype=torch.bool)


def best_partners(score: Float[Tensor, "m m"], most: int, above: float = -torch.inf) -> Bool[Tensor, "m m"]:
    """The pairs that are among the `most` best of either image, of those with a score above a limit."""
    others = score.masked_fill(~every_pair(len(score)), -torch.inf)
    top = others.topk(min(most, len(score)), dim=1)
    chosen = torch.zeros_like(others, dtype=torch.bool).scatter(1, top.indices, top.values > above)
    return chosen | chosen.T


def connected(chosen: Bool[Tensor, "m m"], score: Float[Tensor, "m m"]) -> Bool[Tensor, "m m"]:
    """With those further pairs, of the best scores, that make all images hang together."""
    from scipy.sparse.csgraph import minimum_spanning_tree  # noqa: PLC0415 - slow to import

    first, second = pairs_of(chosen).T
    if not bool(components(first, second, len(chosen)).any()):
        return chosen
    rank = torch.argsort(torch.argsort(score.flatten(), descending=True)).reshape(score.shape) + 1.0
    cost = torch.where(chosen, 0.5, torch.minimum(rank, rank.T)).triu(1)
    tree = torch.from_numpy(minimum_spanning_tree(cost.numpy()).toarray() > 0.0)
    return chosen | tree | tree.T


def in_sequence(names: Sequence[str], window: int) -> Bool[Tensor, "m m"]:
    """Pairs whose names are up to `window` apart in natural order, or 2, 4, 8, 16 and so on apart."""
    place = torch.empty(len(names), dtype=torch.long)
    place[natural_order(names)] = torch.arange(len(names))
    apart = (place[:, None] - place).abs()
    return (apart > 0) & ((apart <= window) | (apart & (apart - 1) == 0))


def natural_order(names: Sequence[str]) -> list[int]:
    """The images by their names, in which numbers count as numbers: 9 comes before 10."""
    padded = [re.sub(r"\d+", lambda number: number[0].zfill(DIGITS), name.lower()) for name in names]
    return sorted(range(len(names)), key=padded.__getitem__)


def show_order(names: Sequence[str]) -> bool:
    """Whether names are numbered one after the other, as cameras do it: from most of them to the next one the last
    number grows by the same, and nothing else changes."""
    found = [LAST_NUMBER.fullmatch(names[image]) for image in natural_order(names)]
    steps = Counter(
        int(after[2]) - int(before[2])
        for before, after in pairwise(found)
        if before is not None and after is not None and before.group(1, 3) == after.group(1, 3)
    )
    return max(steps.values(), default=0) >= NUMBERED * (len(names) - 1) > 0


def pairs_of(chosen: Bool[Tensor, "m m"]) -> Int[Tensor, "p 2"]:
    """Pairs of numbers of images, the first below the second, ascending."""
    return chosen.triu(1).nonzero()
