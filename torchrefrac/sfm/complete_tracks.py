"""More observations of points that have a place: keypoints which the descriptors alone did not match, but which lie
where the point is seen in an image and look like it. Two tracks that turn out to be of one point become one.

Descriptors are compared with those of a few keypoints about one place and not with all of an image, so that a match may
be less distinct than one that nothing guides.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchrefrac.features import Features
from torchrefrac.numerics import components, first_equal, first_of_each, typical_deviation
from torchrefrac.scene import Observations, Scene
from torchrefrac.sfm.adjust import OUTLYING
from torchrefrac.sfm.in_sight import Clusters

CANDIDATES = 6
"""Keypoints about a place, of which several may lie in one (of different orientations)."""
SIMILAR = 0.755
"""Least scalar product of descriptors: those of one point are nearer than 0.7."""
DISTINCT = 0.8
"""Times the distance of the next candidate's descriptor, within which that of the chosen one must be."""


@dataclass(frozen=True, eq=False)
class _Keypoints:
    """Those of a view, where they are looked for by place. first: for each the first one that lies where it does."""

    features: Features

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.features.pixels.numpy())

    @cached_property
    def first(self) -> Int[Tensor, " f"]:
        return first_equal(self.features.pixels)


@dataclass(frozen=True, eq=False)
class _Found:
    """Keypoints `keypoint` of a view that show points `point`, and how similar they are."""

    point: Int[Tensor, " k"]
    keypoint: Int[Tensor, " k"]
    similarity: Float[Tensor, " k"]


def complete_tracks(scene: Scene, features: Sequence[Features], max_error: float) -> Scene:
    """The scene with further observations of its placed points, and with tracks joined that these show to be of one
    point. Nothing new is accepted yet. features: those of each view.

    An observation is looked for as far from where the point is seen as next to no right one errs, by the errors that
    are there already and the noise of its own keypoint, but within max_error pixels.
    """
    seen = scene.observations
    error = scene.errors()[scene.accepted] * seen.precision.expand(len(seen))[scene.accepted]
    if not len(error):
        return scene
    limit = OUTLYING * typical_deviation(error)
    keypoints = [_Keypoints(of_view) for of_view in features]
    keypoint = _keypoints_of(seen, keypoints)
    descriptor, clusters = _mean_descriptors(scene, features, keypoint), Clusters.of(scene)
    extra: list[Observations] = []
    joined: list[Int[Tensor, "2 _"]] = []
    for view in scene.views.registered.nonzero()[:, 0].tolist():
        own = (seen.view == view).nonzero()[:, 0]
        wanted = clusters.before(view).index_fill(0, seen.point[own], False)
        found = _look(scene, view, wanted, keypoints[view], descriptor, (limit, max_error))
        if not len(found.point):
            continue
        owner = torch.full((len(features[view]),), -1, dtype=torch.long)
        owner[keypoint[own]] = seen.point[own]
        of = owner[keypoints[view].first[found.keypoint]]
        joined.append(torch.stack((found.point[of >= 0], of[of >= 0])))
        free = found.keypoint[of < 0]
        pixels, noise = features[view].pixels[free], features[view].noise[free]
        extra.append(Observations(torch.full_like(free, view), found.point[of < 0], pixels, noise=noise))
    return _merged(scene, extra, joined)


def _look(
    scene: Scene,
    view: int,
    wanted: Bool[Tensor, " n"],
    keypoints: _Keypoints,
    descriptor: Float[Tensor, "n d"],
    limits: tuple[float, float],
) -> _Found:
    """What a view shows of the points `wanted`. limits: of errors over noise, and in pixels."""
    none, features = torch.zeros(0, dtype=torch.long), keypoints.features
    point = wanted.nonzero()[:, 0]
    if not len(point) or not len(features):
        return _Found(none, none, torch.zeros(0))
    camera = scene.camera_of(torch.full_like(point, view), point)
    pixels, inside = camera.project(scene.points[point], inside_image=True)
    point, pixels = point[inside], pixels[inside]
    away, near = keypoints.tree.query(pixels.numpy(), k=CANDIDATES, distance_upper_bound=limits[1])
    near = torch.from_numpy(near.astype(np.int64)).reshape(len(point), CANDIDATES).clamp(max=len(features) - 1)
    exists = torch.from_numpy(away).reshape(near.shape) < limits[0] * features.noise[near]
    similarity = torch.einsum("kd,kcd->kc", descriptor[point], features.unit(near))
    similarity = torch.where(exists, similarity, -1.0)
    best, which = similarity.max(dim=1)
    chosen = near.gather(1, which[:, None])
    elsewhere = torch.where(keypoints.first[near] == keypoints.first[chosen], -1.0, similarity).amax(dim=1)
    distinct = (1.0 - best) < DISTINCT**2 * (1.0 - elsewhere)
    good = (best > SIMILAR) & distinct
    return _best_of_each(_Found(point[good], chosen[good, 0], best[good]), keypoints.first)


def _best_of_each(found: _Found, place: Int[Tensor, " f"]) -> _Found:
    """Of points that want keypoints in one place, the most similar one."""
    order = found.similarity.argsort(descending=True)
    _, first = np.unique(place[found.keypoint[order]].numpy(), return_index=True)
    rows = order[torch.from_numpy(first)]
    return _Found(found.point[rows], found.keypoint[rows], found.similarity[rows])


def _keypoints_of(seen: Observations, keypoints: Sequence[_Keypoints]) -> Int[Tensor, " k"]:
    """The first keypoint at each observation's pixel."""
    keypoint = torch.zeros_like(seen.view)
    for view, of_view in enumerate(keypoints):
        rows = (seen.view == view).nonzero()[:, 0]
        if len(rows):
            _, nearest = of_view.tree.query(seen.pixels[rows].numpy())
            keypoint[rows] = of_view.first[torch.from_numpy(np.asarray(nearest))]
    return keypoint


def _mean_descriptors(scene: Scene, features: Sequence[Features], keypoint: Int[Tensor, " k"]) -> Float[Tensor, "n d"]:
    """Of the accepted observations of each point, of length one."""
    seen = scene.observations
    total = torch.zeros(len(scene.points), features[0].descriptors.shape[1])
    for view, of_view in enumerate(features):
        rows = (scene.accepted & (seen.view == view)).nonzero()[:, 0]
        total.index_add_(0, seen.point[rows], of_view.unit(keypoint[rows]))
    return torch.nn.functional.normalize(total, dim=-1)


def _merged(scene: Scene, extra: Sequence[Observations], joined: Sequence[Int[Tensor, "2 _"]]) -> Scene:
    """With the further observations, and with one track in place of those that are joined unless they have two places
    in one image."""
    seen, n, m = scene.observations, len(scene.points), len(scene.views)
    edges = torch.cat((*joined, torch.zeros(2, 0, dtype=torch.long)), dim=1)
    track = first_of_each(components(edges[0], edges[1], n))
    key, times = torch.unique(track[seen.point] * m + seen.view, return_counts=True)
    contradictory = torch.zeros(n, dtype=torch.bool)
    contradictory[key[times > 1] // m] = True
    track = torch.where(contradictory[track], torch.arange(n), track)
    view, point, pixels, noise = (
        torch.cat([getattr(each, name) for each in (seen, *extra)]) for name in ("view", "point", "pixels", "noise")
    )
    accepted = torch.cat((scene.accepted, torch.zeros(len(view) - len(seen), dtype=torch.bool)))
    key = track[point] * m + view
    order = torch.argsort(key, stable=True)  # of two observations in one view the older one comes first
    order = order[torch.cat((torch.ones(1, dtype=torch.bool), key[order].diff() > 0))] if len(order) else order
    observations = Observations(view[order], track[point][order], pixels[order], noise=noise[order])
    points, had_place = scene.points.clone(), scene.placed.nonzero()[:, 0]
    points[track[had_place]] = scene.points[had_place]
    placed = torch.zeros_like(scene.placed).index_fill(0, track[had_place], True)
    return replace(scene, points=points, placed=placed, observations=observations, accepted=accepted[order])
