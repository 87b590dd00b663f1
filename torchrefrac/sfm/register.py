"""Views by their poses: the pair that the reconstruction grows from, and more."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchrefrac.scene import Scene
from torchrefrac.sfm.outcome import Outcome, Registration, Start
from torchrefrac.sfm.pose import Pose, Resection, draws_of
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
    scene, outcomes = register_each(scene, [view], rules)
    return scene, outcomes[0]


def register_each(scene: Scene, views: Sequence[int], rules: Rules) -> tuple[Scene, list[Outcome]]:
    """`register` of some views at once, each by itself from the same points.

    Raises ValueError for rules that find no poses.
    """
    if rules.poses is None:
        raise ValueError("rules.poses is None, but must find poses")
    rows = dict(zip(views, _usable_rows(scene, views), strict=True))
    asked = [view for view in views if len(rows[view]) >= rules.min_registration_inliers]
    known = [_resection(scene, view, rows[view]) for view in asked]
    found = rules.poses.absolute_each(known, [draws_of(rules.seed, view) for view in asked])
    poses = {view: pose for view, pose in zip(asked, found, strict=True) if pose is not None}
    outcomes = {view: _outcome(len(rows[view]), poses.get(view), rules) for view in views}
    done = [view for view in poses if outcomes[view].done]
    if done:
        rotation, center = (
            torch.stack([getattr(poses[view], part) for view in done]) for part in ("rotation", "center")
        )
        accepted = torch.cat([rows[view][poses[view].inliers] for view in done])
        scene = replace(
            scene,
            views=scene.views.at(rotation, center, torch.tensor(done)),
            accepted=scene.accepted.index_fill(0, accepted, True),
        )
    return scene, list(outcomes.values())


def _usable_rows(scene: Scene, views: Sequence[int]) -> list[Int[Tensor, " k"]]:
    """The observations of each of some views by which its pose can be found."""
    seen = scene.observations
    place = torch.full((len(scene.views),), -1).index_copy(
        0, torch.tensor(views, dtype=torch.long), torch.arange(len(views))
    )
    rows = ((place[seen.view] >= 0) & _usable(scene)[seen.point]).nonzero()[:, 0]
    of = place[seen.view[rows]]
    return list(rows[of.argsort(stable=True)].split(torch.bincount(of, minlength=len(views)).tolist()))


def _resection(scene: Scene, view: int, rows: Int[Tensor, " k"]) -> Resection:
    seen = scene.observations
    intrinsics = scene.cameras.of_views(scene.views.camera[view])
    return Resection(view, intrinsics, seen.pixels[rows], scene.points[seen.point[rows]])


def _outcome(seen: int, pose: Pose | None, rules: Rules) -> Outcome:
    """How the registration of a view ends that sees so many usable points."""
    needed, agreeing = rules.min_registration_inliers, 0 if pose is None else int(pose.inliers.sum())
    numbers = {"seen": seen, "needed": needed, "agreeing": agreeing}
    if seen < needed:
        return Outcome(Registration.FEW_POINTS, numbers)
    return Outcome(Registration.DONE if agreeing >= needed else Registration.NO_POSE, numbers)
