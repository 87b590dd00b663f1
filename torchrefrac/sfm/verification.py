"""Geometric verification: which matches of a pair agree on one relative pose."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from torchrefrac.features import Features, PairMatches
from torchrefrac.files.work import Arrays, Work
from torchrefrac.recorder import Recorder
from torchrefrac.sfm.pair_arrays import POSES, packed, unpacked
from torchrefrac.sfm.pose import PairPose, Pixels, PoseInitializer, draws_of

AT_ONCE = 32
"""Pairs that are verified in one part of the work."""
SECONDS_A_PAIR = 0.05

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
    jobs = _jobs([pair for pair in pairs if (pair.first, pair.second) in chosen], features)
    agree = sum(0 if pose is None else int(pose.inliers.sum()) for pose in _poses_of(wide, 0, jobs))
    return agree > MORE_AGREE * sum(chosen.values())


def verify_pairs(
    pairs: Sequence[PairMatches],
    features: Sequence[Features],
    initializer: PoseInitializer,
    min_inliers: int,
    generator: torch.Generator,
    recorder: Recorder,
    work: Work | None = None,
) -> list[VerifiedPair]:
    """Keep the inliers of each pair; pairs with fewer than `min_inliers` are dropped.

    Where many more matches agree if they are seen straight, below the water's level, than do by chance, the water ends
    somewhere, and these are kept too. What comes out for a pair does not depend on which others there are.
    """
    work, seed = work or Work(), int(torch.randint(1 << 31, (), generator=generator))
    enough = [pair for pair in pairs if len(pair) >= min_inliers]
    by_length = sorted(range(len(enough)), key=lambda i: len(enough[i]))
    parts = [by_length[at : at + AT_ONCE] for at in range(0, len(enough), AT_ONCE)]
    jobs = [_jobs([enough[i] for i in part], features) for part in parts]
    function = partial(_poses, initializer, seed)
    poses: dict[int, PairPose | None] = {}
    with recorder.meter(len(pairs), "verifying", "pair") as advance:
        advance(len(pairs) - len(enough), "")
        made_from = initializer, seed, jobs
        for number, arrays in work.parts("verification", made_from, function, jobs, POSES, AT_ONCE * SECONDS_A_PAIR):
            poses.update(zip(parts[number], unpacked(arrays), strict=True))
            advance(len(parts[number]), "")
    verified: list[VerifiedPair] = []
    others: list[Int[Tensor, "_ 2"]] = []
    for step, pair in enumerate(enough):
        pose = poses[step]
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


class _Job(NamedTuple):
    """A pair of images, and the pixels that match."""

    images: tuple[int, int]
    pixels: Pixels


def _jobs(pairs: Sequence[PairMatches], features: Sequence[Features]) -> list[_Job]:
    return [
        _Job((i, j), (features[i].pixels[pair.matches[:, 0]], features[j].pixels[pair.matches[:, 1]]))
        for pair in pairs
        for i, j in ((pair.first, pair.second),)
    ]


def _poses(initializer: PoseInitializer, seed: int, jobs: Sequence[_Job]) -> Arrays:
    return packed(_poses_of(initializer, seed, jobs), [len(job.pixels[0]) for job in jobs])


def _poses_of(initializer: PoseInitializer, seed: int, jobs: Sequence[_Job]) -> list[PairPose | None]:
    """Of each pair, with draws of its own."""
    images, pixels = [job.images for job in jobs], [job.pixels for job in jobs]
    return initializer.relative_each(images, pixels, [draws_of(seed, *pair) for pair in images])
