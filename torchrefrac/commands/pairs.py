"""Which pairs of the photographs of a capture are matched."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.config import OptionError
from torchrefrac.features import Features, MatchOptions, likeness
from torchrefrac.features.matching import AUTO, EXHAUSTIVE, POSITIONS, RETRIEVAL, SEQUENCE, WAYS
from torchrefrac.features.pairs import best_partners, connected, every_pair, in_sequence, pairs_of, show_order
from torchrefrac.files.match_list import read_match_list
from torchrefrac.scene import Capture
from torchrefrac.scene.interfaces import SURFACE
from torchrefrac.sfm.footprints import NO_OVERLAP, has_position, position_scores

FILE = "file"
"""How pairs were chosen that a file lists."""
FEW = 40
"""Photographs, below which all pairs are matched."""
UNLIKELY = -4.0
"""What likeness counts from beside scores of positions, which are larger, where photographs would not hang together."""
FURTHER = 3  # times fewer partners by their looks, where these only add to what positions or an order say


@dataclass(frozen=True, eq=False)
class ChosenPairs:
    """pairs: of photographs, the first below the second, ascending; by: how they were chosen, in the words of
    `matching.pairs`; images: of how many."""

    pairs: Int[Tensor, "p 2"]
    by: str
    images: int

    @property
    def possible(self) -> int:
        """How many pairs there are."""
        return self.images * (self.images - 1) // 2

    @property
    def metrics(self) -> dict[str, str | int]:
        """As metrics of a run."""
        return {"pairs_matched": len(self.pairs), "pairs_possible": self.possible, "pairs_by": self.by}


def require_pairs(capture: Capture, options: MatchOptions) -> None:
    """Raise CaptureError for a list of pairs that cannot be used, OptionError for what is neither a file nor a way, and
    for positions where none is stated."""
    if options.pairs not in WAYS:
        if not Path(options.pairs).is_file():
            known = ", ".join(WAYS)
            raise OptionError(f"matching.pairs is {options.pairs!r}, but must be {known}, or a file that lists pairs")
        read_match_list(Path(options.pairs), capture.names)
    elif options.pairs == POSITIONS and not bool(has_position(capture).any()):
        raise OptionError(f"matching.pairs is {POSITIONS}, but no photograph has one; try {RETRIEVAL} or {SEQUENCE}")


def choose_pairs(capture: Capture, features: Sequence[Features], options: MatchOptions, seed: int) -> ChosenPairs:
    """Which pairs to match, as `options.pairs` says. All photographs hang together by them, unless a file lists them.

    Raises what `require_pairs` raises.
    """
    require_pairs(capture, options)
    count, ways = len(capture), _automatic(capture) if options.pairs == AUTO else (options.pairs,)
    if ways == (EXHAUSTIVE,):
        return ChosenPairs(pairs_of(every_pair(count)), EXHAUSTIVE, count)
    if options.pairs not in WAYS:
        return ChosenPairs(pairs_of(read_match_list(Path(options.pairs), capture.names)), FILE, count)
    chosen, known = ~every_pair(count) & every_pair(count), has_position(capture)
    score = torch.full((count, count), UNLIKELY, dtype=torch.float64)
    if ways != (POSITIONS,) or not bool(known.all()):
        alike = likeness(features, options.ratio, seed).double()
        score = UNLIKELY + alike
        chosen = _by_looks(alike, ways, known, options.per_image)
    if POSITIONS in ways:
        stated = position_scores(capture)
        chosen = chosen | best_partners(stated, options.per_image, above=NO_OVERLAP)
        score = torch.maximum(score, stated)
    if SEQUENCE in ways:
        chosen = chosen | in_sequence(capture.names, options.window)
    return ChosenPairs(pairs_of(connected(chosen, score)), " and ".join(ways), count)


def pairs_left_out(tried: Int[Tensor, "p 2"], registered: Bool[Tensor, " m"]) -> Int[Tensor, "q 2"]:
    """Pairs of photographs that are not registered with all others, without those that were tried; no more than were
    tried before, those with registered photographs first."""
    count = len(registered)
    wanted = every_pair(count) & ~(registered[:, None] & registered)
    wanted[tried[:, 0], tried[:, 1]] = wanted[tried[:, 1], tried[:, 0]] = False
    pairs = pairs_of(wanted)
    alone = ~registered[pairs].any(dim=1)
    return pairs[alone.long().argsort(stable=True)[: len(tried)]]


def _automatic(capture: Capture) -> tuple[str, ...]:
    if len(capture) < FEW:
        return (EXHAUSTIVE,)
    if set(capture.interfaces.kinds) == {SURFACE} and bool(has_position(capture).any()):
        return POSITIONS, RETRIEVAL
    return (RETRIEVAL, SEQUENCE) if show_order(capture.names) else (RETRIEVAL,)


def _by_looks(
    alike: Float[Tensor, "m m"], ways: Sequence[str], known: Bool[Tensor, " m"], most: int
) -> Bool[Tensor, "m m"]:
    """So many partners of each photograph, or fewer where its position or an order says more; by positions alone, those
    of photographs without one."""
    best = best_partners(alike, most)
    if POSITIONS not in ways and RETRIEVAL in ways:
        return best
    chosen = best & ~(known[:, None] & known) if POSITIONS in ways else torch.zeros_like(best)
    return chosen if ways == (POSITIONS,) else chosen | best_partners(alike, max(most // FURTHER, 1))
