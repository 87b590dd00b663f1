"""Points through cameras that are known: tracks that were made elsewhere, as of animals in an aquarium."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.bundle import BundleOptions
from torchrefrac.checks import require
from torchrefrac.refinement import PointEstimate, refine_points
from torchrefrac.scene import Observations, Scene
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
