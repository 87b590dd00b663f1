"""One more view by its absolute pose."""

from dataclasses import replace

import torch
from jaxtyping import Int
from torch import Tensor

from torchrefrac.scene import Scene
from torchrefrac.sfm.outcome import Outcome, Registration
from torchrefrac.sfm.rules import Rules


def visible_points(scene: Scene) -> Int[Tensor, " m"]:
    """How many placed points each view sees."""
    seen = scene.observations
    return torch.bincount(seen.view[scene.placed[seen.point]], minlength=len(scene.views))


def register(scene: Scene, view: int, rules: Rules) -> tuple[Scene, Outcome]:
    """Register `view` by the points it sees; those that agree with its pose become its observations.

    The scene is the one given where that fails.
    """
    if rules.poses is None:
        raise ValueError("rules.poses is None, but must find poses")
    seen = scene.observations
    rows = ((seen.view == view) & scene.placed[seen.point]).nonzero()[:, 0]
    numbers = {"seen": len(rows), "needed": rules.min_registration_inliers, "agreeing": 0}
    if len(rows) < rules.min_registration_inliers:
        return scene, Outcome(Registration.FEW_POINTS, numbers)
    pose = rules.poses.absolute(view, seen.pixels[rows], scene.points[seen.point[rows]], rules.generator)
    if pose is not None:
        numbers["agreeing"] = int(pose.inliers.sum())
    if pose is None or numbers["agreeing"] < rules.min_registration_inliers:
        return scene, Outcome(Registration.NO_POSE, numbers)
    views = scene.views.at(pose.rotation[None], pose.center[None], torch.tensor([view]))
    accepted = scene.accepted.index_fill(0, rows[pose.inliers], True)
    return replace(scene, views=views, accepted=accepted), Outcome(Registration.DONE, numbers)
