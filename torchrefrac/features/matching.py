"""Descriptor matching: mutual nearest neighbours that pass Lowe's ratio test."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.checks import Range, require_ranges

CHUNK, TILE = 512, 1024
"""Rows and columns multiplied at a time: what comes out is looked through while the processor's cache has it."""
GROUPS = 128
"""Of columns, every so many-th in one: the second largest of a row is the largest of its group, or lies in the same
group as the largest of all. To look for two of few groups, and of one group, is cheaper than to look for two of all."""


RANGES = {
    "ratio": Range(above=0.0, at_most=1.0),
    "per_image": Range(at_least=1, at_most=1_000_000),
    "window": Range(at_least=1, at_most=1_000_000),
}
AUTO, EXHAUSTIVE, POSITIONS, SEQUENCE, RETRIEVAL = "auto", "exhaustive", "positions", "sequence", "retrieval"
WAYS = (AUTO, EXHAUSTIVE, POSITIONS, SEQUENCE, RETRIEVAL)


@dataclass(frozen=True)
class MatchOptions:
    """ratio: the nearest descriptor must be closer than this times the second nearest (Lowe, IJCV 2004).

    pairs: which photographs are matched, one of WAYS or the path of a list of pairs. per_image: partners that each has
    by positions, and by retrieval, at most. window: neighbours on either side in the order of names.
    """

    ratio: float = 0.8
    pairs: str = AUTO
    per_image: int = 30
    window: int = 10

    def __post_init__(self) -> None:
        require_ranges(self, RANGES)
        if not self.pairs.strip():
            raise ValueError(f"pairs is empty, but must be {', '.join(WAYS)}, or the path of a list of pairs")


def match(
    descriptors1: Float[Tensor, "n d"], descriptors2: Float[Tensor, "m d"], options: MatchOptions
) -> Int[Tensor, "k 2"]:
    """Index pairs of matching unit descriptors, ascending in the first column.

    Exhaustive; works through chunks of rows so that memory stays small.
    """
    if len(descriptors1) < 1 or len(descriptors2) < 2:
        return torch.zeros(0, 2, dtype=torch.long, device=descriptors1.device)
    similarity, target, best = _nearest(descriptors1, descriptors2)
    squared_distance = (2.0 - 2.0 * similarity).clamp(min=0.0)
    distinct = squared_distance[:, 0] < options.ratio**2 * squared_distance[:, 1]
    rows = torch.arange(len(descriptors1), device=descriptors1.device)
    nearest = similarity[:, 0] == best[target]
    first = torch.full_like(best, len(rows), dtype=torch.long)  # of several that are as near
    first.scatter_reduce_(0, target[nearest], rows[nearest], "amin")
    mutual = distinct & (first[target] == rows)
    return torch.stack((rows[mutual], target[mutual]), dim=-1)


def _nearest(
    descriptors1: Float[Tensor, "n d"], descriptors2: Float[Tensor, "m d"]
) -> tuple[Float[Tensor, "n 2"], Int[Tensor, " n"], Float[Tensor, " m"]]:
    """The two largest scalar products of each row of the first with rows of the second, which one is the larger's, and
    the largest of each row of the second. One buffer serves all chunks: new memory takes as long as what is computed.
    """
    n, m, members = len(descriptors1), len(descriptors2), max(-(-len(descriptors2) // GROUPS), 2)
    buffer = descriptors1.new_full((min(CHUNK, n), members * GROUPS), -torch.inf)
    two, target = descriptors1.new_empty(n, 2), torch.empty(n, dtype=torch.long, device=descriptors1.device)
    best = descriptors1.new_full((m,), -torch.inf)
    for start in range(0, n, CHUNK):
        rows = descriptors1[start : start + CHUNK]
        similarity = buffer[: len(rows)]
        of_groups = similarity.new_full((len(rows), GROUPS), -torch.inf)
        for first in range(0, m, TILE):
            last = min(first + TILE, m)
            part = similarity[:, first:last]
            torch.mm(rows, descriptors2[first:last].T, out=part)
            torch.maximum(best[first:last], part.amax(dim=0), out=best[first:last])
            padded = similarity[:, first : first + TILE].unflatten(1, (-1, GROUPS))
            torch.maximum(of_groups, padded.amax(dim=1), out=of_groups)
        nearest, group = of_groups.topk(2, dim=-1)
        grouped = similarity.view(len(rows), members, GROUPS)
        inside, member = grouped.gather(2, group[:, :1, None].expand(-1, members, 1))[..., 0].topk(2, dim=-1)
        two[start : start + CHUNK, 0] = inside[:, 0]
        two[start : start + CHUNK, 1] = torch.maximum(inside[:, 1], nearest[:, 1])
        target[start : start + CHUNK] = member[:, 0] * GROUPS + group[:, 0]
    return two, target, best
