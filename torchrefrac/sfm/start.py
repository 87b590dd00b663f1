"""The pair of views that the reconstruction grows from."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from torchrefrac.scene import Scene
from torchrefrac.sfm.outcome import Outcome, Start
from torchrefrac.sfm.rules import Rules, SfmOptions
from torchrefrac.sfm.triangulate import triangulate
from torchrefrac.sfm.verification import VerifiedPair

MIN_INITIAL_POINTS = 12


def rank_initial_pairs(pairs: Sequence[VerifiedPair], options: SfmOptions) -> list[VerifiedPair]:
    """Best first: most inliers among the pairs with a sufficient baseline, then the others by their angle.

    Pairs that determine no pose are left out.
    """

    def key(pair: VerifiedPair) -> tuple[bool, float]:
        wide = pair.pose.median_angle >= options.min_initial_angle_deg * torch.pi / 180.0
        return wide, len(pair.pair) if wide else pair.pose.median_angle

    return sorted((pair for pair in pairs if pair.pose.rotation is not None), key=key, reverse=True)


def start(scene: Scene, pair: VerifiedPair, rules: Rules) -> tuple[Scene, Outcome]:
    """Register the two views of `pair`, and place the points that both see."""
    pose = pair.pose
    if pose.rotation is None or pose.center is None:
        return scene, Outcome(Start.NO_POSE)
    views = scene.views.at(pose.rotation, pose.center, torch.tensor([pair.pair.first, pair.pair.second]))
    scene, _ = triangulate(replace(scene, views=views), rules)
    count = int(scene.placed.sum())
    kind = Start.DONE if count >= MIN_INITIAL_POINTS else Start.FEW_POINTS
    return scene, Outcome(kind, {"points": count, "needed": MIN_INITIAL_POINTS})
