"""Which observations, points and views stay."""

from dataclasses import replace

import torch

from torchrefrac.scene import Scene
from torchrefrac.sfm.outcome import Filtering, Outcome
from torchrefrac.sfm.rays import Tracks
from torchrefrac.sfm.rules import Rules


def filter_points(scene: Scene, rules: Rules) -> tuple[Scene, Outcome]:
    """Judge all observations: accept those within rules.max_error, of points with enough of them and enough angle.

    An observation that was set aside comes back when its error has become small. Views that fewer than
    rules.min_support observations are left to support are no longer registered; the outcome names them.
    """
    close, seen, registered = scene.errors() < rules.max_error, scene.observations, scene.views.registered
    alone = torch.as_tensor(rules.min_track_length) < 2  # that one observation is enough for, and no angle
    while True:
        accepted = close & registered[seen.view]
        count = torch.bincount(seen.point[accepted], minlength=len(scene.points))
        placed = scene.placed & (count >= rules.min_track_length)
        accepted &= placed[seen.point]
        if rules.min_angle_deg > 0.0:
            tracks = Tracks.of(scene, accepted.nonzero()[:, 0])
            placed = torch.zeros_like(placed)
            placed[tracks.ids] = tracks.opening() > rules.min_angle_deg * torch.pi / 180.0
            placed |= alone & (count > 0)
            accepted &= placed[seen.point]
        lost = registered & (torch.bincount(seen.view[accepted], minlength=len(registered)) < rules.min_support)
        if not bool(lost.any()):
            break
        registered = registered & ~lost
    lost = (scene.views.registered & ~registered).nonzero()[:, 0].tolist()
    scene = replace(scene, placed=placed, accepted=accepted, views=replace(scene.views, registered=registered))
    kind = Filtering.LOST_VIEWS if lost else Filtering.DONE
    return scene, Outcome(kind, {"points": int(placed.sum())}, tuple(lost))


def affordable_length(scene: Scene, rules: Rules, wanted: int) -> int:
    """The track length that can be asked for: `wanted`, or less where a view would be left without support. Points that
    only two views see are the least certain, but where photographs overlap little they are all there is."""
    for length in range(min(wanted, scene.views.num_registered), 2, -1):
        filtered, _ = filter_points(scene, replace(rules, min_track_length=length, min_support=0))
        if int(filtered.support()[scene.views.registered].min()) >= rules.min_registration_inliers:
            return length
    return 2
