"""Descriptor matching: mutual nearest neighbours that pass Lowe's ratio test."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.checks import Range, require_ranges

CHUNK = 512


@dataclass(frozen=True)
class MatchOptions:
    """ratio: the nearest descriptor must be closer than this times the second nearest (Lowe, IJCV 2004)."""

    ratio: float = 0.8

    def __post_init__(self) -> None:
        require_ranges(self, {"ratio": Range(above=0.0, at_most=1.0)})


def match(
    descriptors1: Float[Tensor, "n d"], descriptors2: Float[Tensor, "m d"], options: MatchOptions
) -> Int[Tensor, "k 2"]:
    """Index pairs of matching unit descriptors, ascending in the first column.

    Exhaustive; works through chunks of rows so that memory stays small.
    """
    if len(descriptors1) < 1 or len(descriptors2) < 2:
        return torch.zeros(0, 2, dtype=torch.long, device=descriptors1.device)
    best = descriptors1.new_full((len(descriptors2),), -torch.inf)
    similar, nearest = [], []
    for start in range(0, len(descriptors1), CHUNK):
        similarity = descriptors1[start : start + CHUNK] @ descriptors2.T
        top = similarity.topk(2, dim=-1)
        similar.append(top.values)
        nearest.append(top.indices[:, 0])
        best = torch.maximum(best, similarity.amax(dim=0))  # much cheaper than to ask where it is, too
    target, similarity = torch.cat(nearest), torch.cat(similar)
    squared_distance = (2.0 - 2.0 * similarity).clamp(min=0.0)
    distinct = squared_distance[:, 0] < options.ratio**2 * squared_distance[:, 1]
    rows = torch.arange(len(descriptors1), device=descriptors1.device)
    nearest = similarity[:, 0] == best[target]
    first = torch.full_like(best, len(rows), dtype=torch.long)  # of several that are as near
    first.scatter_reduce_(0, target[nearest], rows[nearest], "amin")
    mutual = distinct & (first[target] == rows)
    return torch.stack((rows[mutual], target[mutual]), dim=-1)
