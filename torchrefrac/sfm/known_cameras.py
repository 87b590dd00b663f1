"""Points through cameras that are known, as those that stand still while what they look at moves: of tracks that were
made elsewhere, as of animals in an aquarium, and of photographs of another moment."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.bundle import BundleOptions
from torchrefrac.checks import require
from torchrefrac.features import Features, PairMatches, build_tracks
from torchrefrac.refinement import PointEstimate, refine_points
from torchrefrac.scene import Observations, Scene
from torchrefrac.sfm.filter_points import filter_points
from torchrefrac.sfm.rays import Rays
from torchrefrac.sfm.rules import Rules
from torchrefrac.sfm.triangulate import triangulate

EXACT = 1e-18
"""Part of its cost that a point may still lose: it is where it reprojects best to ten digits of its depth."""


def triangulate_tracks(
    scene: Scene, seen: Observations, pixel_sigma: float = 0.3, max_error: float = 4.0
) -> tuple[PointEstimate, Bool[Tensor, " k"]]:
    """The points n that best explain observations, in any order, by registered views of a scene, whose own points do
    not matter; and which observations they rest on.

    pixel_sigma: noise of a pixel coordinate, of which the covariances follow, with cameras and water as if they were
    exact. max_error, in pixels: while an observation of a point is farther off, the worst is set aside, down to two;
    where two do not agree either, or do not determine a point, it is not valid. Raises SceneError for views that the
    scene lacks, ValueError for numbers that cannot be.
    """
    require(seen.pixels, "pixels")
    require(max_error, "max_error", above=0.0)
    order = seen.point.argsort(stable=True)
    length = torch.bincount(seen.point)
    points = seen.pixels.new_zeros(len(length), 3)
    start = scene.with_points(points, torch.zeros_like(points, dtype=torch.uint8), seen[order])
    start = replace(start, placed=torch.zeros_like(start.placed), accepted=torch.zeros_like(start.accepted))
    start.check()
    rules = Rules(
        max_error=max_error,
        max_dropped=max(length.tolist(), default=2) - 2,
        min_angle_deg=0.0,
        rough=True,
        loss_scale=max_error,
        bundle=BundleOptions(pixel_sigma=pixel_sigma),
    )
    found, _ = triangulate(start, rules)
    used = found.observations[found.accepted]
    cameras = found.cameras_of(used)
    estimate = refine_points(cameras, used.pixels, used.point, found.points, pixel_sigma, tolerance=EXACT)
    return estimate, torch.empty_like(found.accepted).index_copy(0, order, found.accepted)


def points_of_photographs(
    scene: Scene, features: Sequence[Features], matches: Sequence[PairMatches], rules: Rules
) -> Scene:
    """The views of `scene`, which stay where they are, with the points that their keypoints show.

    features: of each view; matches: between them, of which those count whose rays meet: both keypoints are within
    rules.max_error of where the point is seen. Two matches of one track that no two views could tell apart are not
    found out before a third view sees the point.
    """
    agreeing = [agreeing_matches(scene, features, pair, rules.max_error) for pair in matches]
    observations, colors = build_tracks(features, agreeing)
    nothing = torch.zeros(len(colors), dtype=torch.bool)
    tracks = replace(
        scene.with_points(torch.zeros(len(colors), 3, dtype=torch.float64), colors, observations),
        placed=nothing,
        accepted=torch.zeros(len(observations), dtype=torch.bool),
    )
    placed, _ = triangulate(tracks, rules)
    return filter_points(placed, rules)[0].trimmed()


def agreeing_matches(scene: Scene, features: Sequence[Features], pair: PairMatches, max_error: float) -> PairMatches:
    """Those of a pair of views whose rays meet, in a point that both see within max_error pixels."""
    if not len(pair):
        return pair
    view = torch.tensor([pair.first, pair.second])
    both = torch.stack([features[i].pixels[pair.matches[:, k]] for k, i in enumerate(view.tolist())], dim=1)
    camera = scene.camera_of(view)

    def height(points: Float[Tensor, "k 3"]) -> Float[Tensor, " k"]:
        return scene.interfaces.heights(points[:, None], scene.views.interface[view]).mean(dim=-1)

    points, _, valid = Rays.of(camera, both).meet(height)
    projected, possible = camera.project(points[:, None])
    error = (projected - both).norm(dim=-1).amax(dim=-1)
    return replace(pair, matches=pair.matches[valid & possible.all(dim=-1) & (error < max_error)])
