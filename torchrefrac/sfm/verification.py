"""Geometric verification: which matches of a pair agree on one relative pose."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from torchrefrac.features import Features, PairMatches
from torchrefrac.recorder import Recorder
from torchrefrac.sfm.pose import PairPose, PoseInitializer

BY_CHANCE = 0.005
"""Share of the matches that agree, of further ones that do if nothing is bent, which wrong matches stay far below."""

MORE_AGREE, SHOWN_BY = 1.1, 3
"""Times as many matches that agree within a wide limit as within the usual one, in so many of the pairs in which most
do not: errors are larger than noise then. Wrong matches alone are spread too wide for that."""


@dataclass(frozen=True)
class VerifiedPair:
    """The matches of a pair that a relative pose explains, and that pose."""

    pair: PairMatches
    pose: PairPose
    num_putative: int


def errors_are_rough(
    pairs: Sequence[PairMatches],
    verified: Sequence[VerifiedPair],
    features: Sequence[Features],
    wide: PoseInitializer,
) -> bool:
    """Whether clearly more matches agree on the poses that `wide`, with a wider limit of errors, finds: the water is
    not flat, or something else is not as it was stated."""
    left_over = sorted(verified, key=lambda one: len(one.pair) - one.num_putative)[:SHOWN_BY]
    chosen = {(one.pair.first, one.pair.second): len(one.pair) for one in left_over}
    generator = torch.Generator().manual_seed(0)
    found = (_relative(wide, pair, features, generator) for pair in pairs if (pair.first, pair.second) in chosen)
    agree = sum(0 if pose is None else int(pose.inliers.sum()) for pose in found)
    return agree > MORE_AGREE * sum(chosen.values())


def verify_pairs(
    pairs: Sequence[PairMatches],
    features: Sequence[Features],
    initializer: PoseInitializer,
    min_inliers: int,
    generator: torch.Generator,
    recorder: Recorder,
) -> list[VerifiedPair]:
    """Keep the inliers of each pair; pairs with fewer than `min_inliers` are dropped.

    Where many more matches agree if they are seen straight, below the water's level, than do by chance, the water ends
    somewhere, and these are kept too.
    """
    verified: list[VerifiedPair] = []
    others: list[Int[Tensor, "_ 2"]] = []
    for step, pair in enumerate(recorder.track(pairs, len(pairs), "verifying", "pair")):
        if len(pair) < min_inliers:
            continue
        pose = _relative(initializer, pair, features, generator)
        count = int(pose.inliers.sum()) if pose is not None else 0
        recorder.scalar("verification/inliers", count, step)
        recorder.scalar("verification/inlier_ratio", count / len(pair), step)
        if pose is not None and count >= min_inliers:
            kept = PairMatches(pair.first, pair.second, pair.matches[pose.inliers])
            verified.append(VerifiedPair(kept, pose, len(pair)))
            others.append(pair.matches[:0] if pose.straight is None else pair.matches[pose.straight])
    straight, bent = sum(map(len, others)), sum(len(one.pair) for one in verified)
    if straight < max(min_inliers, BY_CHANCE * bent):
        return verified
    return [
        replace(one, pair=replace(one.pair, matches=torch.cat((one.pair.matches, more))))
        for one, more in zip(verified, others, strict=True)
    ]


def _relative(
    initializer: PoseInitializer, pair: PairMatches, features: Sequence[Features], generator: torch.Generator
) -> PairPose | None:
    first = features[pair.first].pixels[pair.matches[:, 0]]
    second = features[pair.second].pixels[pair.matches[:, 1]]
    return initializer.relative((pair.first, pair.second), (first, second), generator)
