"""Descriptor matching: mutual nearest neighbours that pass Lowe's ratio test."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.checks import Range, require_ranges
from torchrefrac.features.networks import content_of, require_file
from torchrefrac.features.rough_products import Nearest, RoughDescriptors, nearest_of

AT_ONCE = 1 << 24
"""Products that are looked for exactly at a time."""
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

    matcher: nearest neighbours, or LightGlue, which needs keypoints of the network that it was trained_on. weights:
    path of a file of LightGlue's, by default those that kornia downloads.
    """

    ratio: float = 0.8
    pairs: str = AUTO
    per_image: int = 30
    window: int = 10
    matcher: Literal["nearest", "lightglue"] = "nearest"
    weights: str | None = None
    trained_on: Literal["disk", "aliked"] = "disk"

    def __post_init__(self) -> None:
        require_ranges(self, RANGES)
        if not self.pairs.strip():
            raise ValueError(f"pairs is empty, but must be {', '.join(WAYS)}, or the path of a list of pairs")
        require_file(self.weights)

    @property
    def made_from(self) -> tuple[str, ...]:
        """What is in the file of weights, as a fingerprint."""
        return content_of(self.weights)


def match(
    descriptors1: Float[Tensor, "n d"], descriptors2: Float[Tensor, "m d"], options: MatchOptions
) -> Int[Tensor, "k 2"]:
    """Index pairs of matching unit descriptors, ascending in the first column.

    Exhaustive: rough products say of nearly all descriptors what exact ones do, and which these are; exact products of
    single precision decide about the others. Works through chunks of rows so that memory stays small.
    """
    if len(descriptors1) < 1 or len(descriptors2) < 2:
        return torch.zeros(0, 2, dtype=torch.long, device=descriptors1.device)
    first, second = RoughDescriptors.of(descriptors1), RoughDescriptors.of(descriptors2)
    rows, target = _distinct(descriptors1, descriptors2, nearest_of(first, second), options.ratio)
    wanted, place = target.unique(return_inverse=True)
    back = nearest_of(second.rows(wanted), first)
    nearest, unclear = back.target, (~back.is_certain).nonzero()[:, 0]
    nearest[unclear], _ = _exactly_nearest(descriptors2[wanted[unclear]], descriptors1)
    mutual = nearest[place] == rows
    return torch.stack((rows[mutual], target[mutual]), dim=-1)


def _distinct(
    descriptors1: Float[Tensor, "n d"], descriptors2: Float[Tensor, "m d"], found: Nearest, ratio: float
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """Which of the first pass the ratio test, and their nearest of the second."""
    most, least = _limit(found.second - found.error, ratio), _limit(found.second + found.error, ratio)
    rows = (_squared_distance(found.largest + found.error) < most).nonzero()[:, 0]
    target, certain = found.target[rows], found.is_certain[rows]
    distance = _squared_distance((descriptors1[rows] * descriptors2[target]).sum(dim=1))
    passes, fails = certain & (distance < least[rows]), certain & (distance >= most[rows])
    unclear = (~passes & ~fails).nonzero()[:, 0]
    target[unclear], two = _exactly_nearest(descriptors1[rows[unclear]], descriptors2)
    passes[unclear] = _squared_distance(two[:, 0]) < _limit(two[:, 1], ratio)
    return rows[passes], target[passes]


def _exactly_nearest(
    some: Float[Tensor, "k d"], others: Float[Tensor, "m d"]
) -> tuple[Int[Tensor, " k"], Float[Tensor, "k 2"]]:
    """Of several that are as near the first, and the two largest products."""
    nearest, two = torch.empty(len(some), dtype=torch.long, device=some.device), some.new_empty(len(some), 2)
    rows = max(AT_ONCE // len(others), 1)
    for start in range(0, len(some), rows):
        done = slice(start, start + rows)
        products = some[done] @ others.T
        nearest[done], two[done] = products.argmax(dim=1), products.topk(2, dim=1).values
    return nearest, two


def _squared_distance(product: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    return (2.0 - 2.0 * product).clamp(min=0.0)


def _limit(second: Float[Tensor, " n"], ratio: float) -> Float[Tensor, " n"]:
    """What the squared distance of the nearest must be less than."""
    return ratio * ratio * _squared_distance(second)
