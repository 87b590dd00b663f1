"""Two reconstructions from the same tracks become one, by what is known in both: poses, points or stated positions."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.geometry import (
    Freedom,
    Similarity,
    align_poses,
    robust_level_similarity,
    robust_similarity,
)
from torchrefrac.scene import Capture, Scene, Survey, Views
from torchrefrac.sfm.filter_points import filter_points
from torchrefrac.sfm.frame import transformed
from torchrefrac.sfm.outcome import Joining, Outcome
from torchrefrac.sfm.register import register_each
from torchrefrac.sfm.rules import Rules
from torchrefrac.sfm.survey_frame import known_places
from torchrefrac.sfm.triangulate import triangulate

MAX_ANGLE = math.radians(2.0)
"""By which a pose may differ in the two reconstructions, each of which is bent a little."""
LOOSE = 4.0
"""Times that observations may err before both are adjusted as one."""
OTHER_LEVEL, SURE = 0.1, 3.0
"""Share of the height of the cameras, beside so many standard deviations, by which the water may stand higher or lower
in one of them, as positions have it."""


def join(scene: Scene, other: Scene, rules: Rules, capture: Capture, survey: Survey) -> tuple[Scene, Outcome]:
    """`scene` with the views and points of `other`, a reconstruction of other views from the same tracks.

    It is brought into the frame of the scene by views that see enough points of both to have a pose in each, most of
    which must agree; or by tracks that have a place in both; or by the positions of cameras and ground control that a
    `survey` states, with those of the capture among them. Under a water surface, whose plane both share, heading,
    place and scale are open: one such view determines them, or two stated positions in each of them whose horizontal
    distance is larger than their errors. Without refraction there are two views, and three positions not on a line
    unless gravity is known; through a port the scale is known, and one view does.

    Where nothing ties them, or it does not determine how they lie to each other, the scene is the one given, and the
    outcome says why. What is joined is not yet adjusted: observations may err by LOOSE times rules.max_error. Raises
    ValueError for rules that find no poses, and where both have the same views.
    """
    if bool((scene.views.registered & other.views.registered).any()):
        raise ValueError("other.views has views that are registered in the scene, too, but must have others")
    views, needed = other.views.num_registered, rules.min_registration_inliers
    numbers: dict[str, float] = {"views": views, "common": 0, "points": 0, "positions": 0, "agreeing": 0}
    for tie in _ties(scene, other, rules):
        numbers["common"] += tie.views
        numbers["points"] += tie.points
        numbers["agreeing"] = max(tie.agreeing, numbers["agreeing"])
        if 2 * tie.agreeing <= tie.views + tie.points or tie.other_in_scene is None:
            continue
        joined = _joined(scene, other, tie.other_in_scene, rules)
        across = joined.supported_by(scene.views.registered) & joined.supported_by(other.views.registered)
        if int(across.sum()) >= needed:
            return joined, Outcome(Joining.DONE, numbers)
    change, outcome = _by_positions(scene, other, capture, survey)
    if change is not None:
        return _joined(scene, other, change, rules), Outcome(Joining.DONE, {**numbers, **outcome.numbers})
    kind = outcome.kind
    if kind is Joining.NOTHING and numbers["common"] + numbers["points"]:
        kind = Joining.DISAGREEING if numbers["agreeing"] else Joining.SCALE_OPEN
    return scene, Outcome(kind, {**numbers, **outcome.numbers})


class _Tie(NamedTuple):
    """How the other scene lies in the frame of the first, if anything says it; by how many views and points, of which
    so many agree."""

    other_in_scene: Similarity | None
    views: int = 0
    points: int = 0
    agreeing: int = 0


def _ties(scene: Scene, other: Scene, rules: Rules) -> Iterator[_Tie]:
    """By what is seen: views first."""
    yield _by_views(scene, other, rules)
    both = scene.placed & other.placed
    if int(both.sum()) >= rules.min_registration_inliers:
        yield _by_points(scene, other, both, rules)


def _by_views(scene: Scene, other: Scene, rules: Rules) -> _Tie:
    """By the views that have a pose in both."""
    here, there = _with_views(scene, other, rules), _with_views(other, scene, rules)
    both = here.registered & there.registered
    distance = (scene.points[scene.placed] - scene.middle).norm(dim=-1)
    if not bool(both.any()) or not len(distance):
        return _Tie(None)
    found = align_poses(there.pose[both], here.pose[both], _freedom(scene), distance.median(), MAX_ANGLE)
    if found is None:
        return _Tie(None, views=int(both.sum()))
    return _Tie(found.b_from_a, views=int(both.sum()), agreeing=int(found.agreeing.sum()))


def _with_views(scene: Scene, other: Scene, rules: Rules) -> Views:
    """The views of a scene, with those of the other that see enough of its points."""
    return register_each(scene, other.views.registered.nonzero()[:, 0].tolist(), rules)[0].views


def _by_points(scene: Scene, other: Scene, both: Bool[Tensor, " n"], rules: Rules) -> _Tie:
    """By the points of tracks that have a place in both; errors are those that pixels have at their distance."""
    source, target = other.points[both], scene.points[both]
    sigma = (target - scene.middle).norm(dim=-1) * rules.max_error / scene.cameras.focal.mean()
    if _freedom(scene) is Freedom.LEVEL:
        change = _in_plane(robust_level_similarity(source, target, sigma)[0])
    else:
        change = robust_similarity(source, target, sigma)[0]
    agreeing = (change.apply(source) - target).norm(dim=-1) < LOOSE * sigma
    return _Tie(change, points=len(source), agreeing=int(agreeing.sum()))


def _freedom(scene: Scene) -> Freedom:
    """What may differ between the frames of two reconstructions of one capture."""
    if scene.interfaces.stand_in_world:
        return Freedom.LEVEL
    return Freedom.RIGID if scene.interfaces.refract() else Freedom.SIMILARITY


def _in_plane(change: Similarity) -> Similarity:
    """The same without lift: both have the water at z = 0."""
    return replace(change, translation=change.translation * change.translation.new_tensor((1.0, 1.0, 0.0)))


def _by_positions(scene: Scene, other: Scene, capture: Capture, survey: Survey) -> tuple[Similarity | None, Outcome]:
    """By stated positions of cameras and of ground control, which place each of them in the frame of the survey."""
    every = [known_places(one, capture, survey) for one in (scene, other)]
    positions = min(len(each.places) for each in every)
    if not positions:
        return None, Outcome(Joining.NOTHING)
    numbers = {"positions": len(every[1].places)}
    first, second = (each.survey_from_scene(capture) for each in every)
    if first is None or second is None:
        return None, Outcome(Joining.UNDETERMINED, numbers)
    if _freedom(scene) is not Freedom.LEVEL:
        return first.inverse @ second, Outcome(Joining.DONE, numbers)
    apart = float((second.translation[2] - first.translation[2]).abs())
    height = float(second.scale * other.views.center[other.views.registered, 2].mean())
    doubt = sum(float(each.places.covariance[:, 2, 2].mean()) / len(each.places) for each in every) ** 0.5
    if apart > OTHER_LEVEL * height + SURE * doubt:
        return None, Outcome(Joining.OTHER_LEVEL, numbers | {"apart": apart, "height": height})
    return _in_plane(first.inverse @ second), Outcome(Joining.DONE, numbers)


def _joined(scene: Scene, other: Scene, change: Similarity, rules: Rules) -> Scene:
    """With the views and points of the other, after a change of its frame. Tracks that both placed are placed once
    more, and all observations judged."""
    other = transformed(other, change)
    which, both = other.views.registered.nonzero()[:, 0], scene.placed & other.placed
    theirs = other.placed & ~scene.placed
    joined = replace(
        scene,
        views=scene.views.at(other.views.rotation[which], other.views.center[which], which),
        points=torch.where(theirs[:, None], other.points, scene.points),
        placed=scene.placed | other.placed,
        accepted=scene.accepted | other.accepted,
    )
    loosely = replace(rules, max_error=LOOSE * rules.max_error)
    return filter_points(triangulate(joined, loosely, both)[0], loosely)[0]
