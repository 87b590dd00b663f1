"""Points for tracks that two or more registered views see."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchrefrac.refinement import refine_points
from torchrefrac.scene import Scene, reprojection_errors
from torchrefrac.sfm.outcome import Outcome, Triangulation
from torchrefrac.sfm.rays import Tracks
from torchrefrac.sfm.rules import Rules


def triangulate(scene: Scene, rules: Rules, wanted: Bool[Tensor, " n"] | None = None) -> tuple[Scene, Outcome]:
    """Place the points `wanted`, by default all that have no position.

    A point is placed when all its observations reproject within rules.max_error and its rays open by
    rules.min_angle_deg. While an error is too large, the worst observation is set aside, up to rules.max_dropped times
    and down to two. Placed points then move to where they reproject best; under `rough` rules they are judged there.
    What cannot be placed has no position afterwards, and an infinite max_error judges nothing.
    """
    wanted = ~scene.placed if wanted is None else wanted
    seen = scene.observations
    rows = (scene.views.registered[seen.view] & wanted[seen.point]).nonzero()[:, 0]
    points, placed, accepted = scene.points.clone(), scene.placed & ~wanted, scene.accepted & ~wanted[seen.point]
    judged = rules.max_error < torch.inf
    for _ in range(1 + rules.max_dropped if judged else 1):
        rows = rows[torch.bincount(seen.point[rows], minlength=len(placed))[seen.point[rows]] >= 2]
        if not len(rows):
            break
        tracks = Tracks.of(scene, rows)
        cameras, slot = tracks.cameras, tracks.slot
        found, angle, good = tracks.meet()
        if rules.rough:
            estimate = refine_points(cameras, tracks.pixels, slot, found, rules.bundle.pixel_sigma, rules.loss_scale)
            found, good = estimate.points, estimate.valid
        error = reprojection_errors(cameras, found[slot], tracks.pixels)
        worst = error.new_zeros(len(found)).scatter_reduce(0, slot, error, "amax")
        if judged:
            good = good & (worst < rules.max_error)
        new = good & (angle > torch.pi / 180.0 * rules.min_angle_deg) if rules.min_angle_deg else good
        ids = tracks.ids[new]
        points[ids], placed[ids], accepted[rows[new[slot]]] = found[new], True, True
        failing = ~good[slot]
        at_worst = failing & (error == worst[slot])
        rows = rows[failing & ~_first_of_each(at_worst, slot, len(found))]
    new, scene = placed & wanted, replace(scene, points=points, placed=placed, accepted=accepted)
    if not bool(new.any()):
        return scene, Outcome(Triangulation.NOTHING)
    outcome = Outcome(Triangulation.DONE, {"points": int(new.sum())})
    return scene if rules.rough else _polished(scene, new, rules), outcome


def _polished(scene: Scene, new: Bool[Tensor, " n"], rules: Rules) -> Scene:
    """The points `new` at the least reprojection error of their accepted observations."""
    tracks = Tracks.of(scene, (scene.accepted & new[scene.observations.point]).nonzero()[:, 0])
    bundle, start = rules.bundle, scene.points[tracks.ids]
    estimate = refine_points(tracks.cameras, tracks.pixels, tracks.slot, start, bundle.pixel_sigma, bundle.loss_scale)
    return replace(scene, points=scene.points.index_copy(0, tracks.ids, estimate.points))


def _first_of_each(mask: Bool[Tensor, " k"], slot: Int[Tensor, " k"], count: int) -> Bool[Tensor, " k"]:
    """Of the rows in the mask the first one of each slot."""
    order = torch.arange(len(mask), device=mask.device)
    first = torch.full((count,), len(mask), device=mask.device).scatter_reduce(0, slot[mask], order[mask], "amin")
    return mask & (first[slot] == order)
