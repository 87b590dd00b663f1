"""Points of photographs whose poses are known, as of cameras that stand still while what they look at moves."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.features import Features, PairMatches, build_tracks
from torchrefrac.scene import Scene
from torchrefrac.sfm.filter_points import filter_points
from torchrefrac.sfm.rays import Rays
from torchrefrac.sfm.rules import Rules
from torchrefrac.sfm.triangulate import triangulate


def points_at_known_poses(
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
    planes, surfaces = scene.interfaces, scene.interfaces.of_views(scene.views.interface[view])

    def height(points: Float[Tensor, "k 3"]) -> Float[Tensor, " k"]:
        if planes.move_with_camera:
            return torch.full_like(points[..., 2], -torch.inf)
        return surfaces.plane.signed_distance(points[..., None, :]).mean(dim=-1)

    points, _, valid = Rays.of(camera, both).meet(height)
    projected, possible = camera.project(points[:, None])
    error = (projected - both).norm(dim=-1).amax(dim=-1)
    return replace(pair, matches=pair.matches[valid & possible.all(dim=-1) & (error < max_error)])
