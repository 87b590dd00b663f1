"""Views by their poses: the pair that the reconstruction grows from, and one more."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchrefrac.scene import Scene
from torchrefrac.sfm.outcome import Outcome, Registration, Start
from torchrefrac.sfm.rules import Rules, SfmOptions
from torchrefrac.sfm.triangulate import triangulate
from torchrefrac.sfm.verification import VerifiedPair

MIN_INITIAL_POINTS = 12


def rank_initial_pairs(pairs: Sequence[VerifiedPair], options: SfmOptions) -> list[VerifiedPair]:
    """Best first: most inliers among the pairs with a sufficient baseline, then the others by their angle. Pairs that
    determine no pose are left out."""

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


def visible_points(scene: Scene) -> Int[Tensor, " m"]:
    """How many placed points each view sees by which its pose can be found."""
    seen = scene.observations
    return torch.bincount(seen.view[_usable(scene)[seen.point]], minlength=len(scene.views))


def _usable(scene: Scene) -> Bool[Tensor, " n"]:
    """Points by which poses can be found: those in the water and above its level, but not dry ones below it."""
    return scene.placed if scene.dry is None else scene.placed & ~scene.outside_water()


def register(scene: Scene, view: int, rules: Rules) -> tuple[Scene, Outcome]:
    """Register `view` by the points it sees; those that agree with its pose become its observations.

    The scene is the one given where that fails. Raises ValueError for rules that find no poses.
    """
    if rules.poses is None:
        raise ValueError("rules.poses is None, but must find poses")
    seen = scene.observations
    rows = ((seen.view == view) & _usable(scene)[seen.point]).nonzero()[:, 0]
    numbers = {"seen": len(rows), "needed": rules.min_registration_inliers, "agreeing": 0}
    if len(rows) < rules.min_registration_inliers:
        return scene, Outcome(Registration.FEW_POINTS, numbers)
    intrinsics = scene.cameras.of_views(scene.views.camera[view])
    pose = rules.poses.absolute(view, intrinsics, seen.pixels[rows], scene.points[seen.point[rows]], rules.generator)
    if pose is not None:
        numbers["agreeing"] = int(pose.inliers.sum())
    if pose is None or numbers["agreeing"] < rules.min_registration_inliers:
        return scene, Outcome(Registration.NO_POSE, numbers)
    views = scene.views.at(pose.rotation[None], pose.center[None], torch.tensor([view]))
    accepted = scene.accepted.index_fill(0, rows[pose.inliers], True)
    return replace(scene, views=views, accepted=accepted), Outcome(Registration.DONE, numbers)
