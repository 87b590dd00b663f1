"""Whether photographs that were reconstructed as if taken in air show water.

A scene without refraction bends until it fits, which it never does to the noise. A part of it is adjusted again as if
it lay under water, at the level that fits best: where there is water the errors fall to a fraction. Where there is none
the level moves to where it does nothing, and the errors stay.
"""

from dataclasses import replace

import torch

from torchrefrac.bundle import UnadjustableError
from torchrefrac.numerics import thin
from torchrefrac.scene import Capture, Interfaces, Scene, Survey, SurveyError
from torchrefrac.sfm.readjust import readjust
from torchrefrac.sfm.rules import ReadjustOptions
from torchrefrac.sfm.water_level import at_best_level

VIEWS, POINTS, LEAST_POINTS = 6, 500, 30
ANY = 1e6  # pixels
FRESH_WATER = 1.333
CLEARLY = 0.9  # by how much smaller errors through water must be at least


def errors_in_air_and_water(scene: Scene, stated: Capture) -> tuple[float, float] | None:
    """Median reprojection errors, pixels, of a part of a scene that was reconstructed without refraction: as it is, and
    adjusted as if it lay under the water that is `stated` (fresh water, where that does not refract), with the lens as
    stated.

    None where gravity is not stated, so that the water could be tilted in any way, or too little is reconstructed.
    """
    if not stated.has_gravity or scene.views.num_registered < 2:
        return None
    part = _best_seen(scene)
    if len(part.points) < LEAST_POINTS:
        return None
    ratio = stated.index_ratio if stated.index_ratio > 1.0 else FRESH_WATER
    wet = replace(part, cameras=stated.cameras.exact(), interfaces=Interfaces.level(ratio))
    options = ReadjustOptions()
    options = replace(options, bundle=replace(options.bundle, refine=("plane_height",)))
    try:
        wet = at_best_level(wet, _gravity(part, stated), options)
    except (UnadjustableError, SurveyError):
        return None
    return float(part.errors().median()), float(wet.errors().median())


def fits_better_in_air(scene: Scene, stated: Capture) -> bool:
    """Whether a part of a scene that was reconstructed through water agrees as well with itself without, or better: it
    may show land. Through water, whose level is one more thing that adapts to errors, it must agree clearly better.
    Both are adjusted from what the scene has, with the intrinsics as uncertain as they are stated to be."""
    part = _best_seen(scene)
    if len(part.points) < LEAST_POINTS:
        return False
    air = replace(part, interfaces=Interfaces.level(1.0), dry=None)
    try:
        errors = [_typical_error(each, stated) for each in (air, part)]
    except (UnadjustableError, SurveyError):
        return False
    return CLEARLY * errors[0] < errors[1]


def _typical_error(scene: Scene, stated: Capture) -> float:
    """Median reprojection error, pixels, once everything is adjusted; of points that find no place an infinite one."""
    adjusted, _ = readjust(scene, _gravity(scene, stated), ReadjustOptions(max_error=ANY, rounds=1))
    return float(adjusted.errors().median())


def _best_seen(scene: Scene) -> Scene:
    """The view with most observations and those that see most of its points, with some of these points."""
    seen, support = scene.observations, scene.support()
    of_best = torch.zeros(len(scene.points), dtype=torch.bool)
    of_best[seen.point[seen.view == support.argmax()]] = True
    common = torch.bincount(seen.view[of_best[seen.point]], minlength=len(scene.views))
    wanted = torch.zeros_like(scene.views.registered)
    wanted[common.topk(min(VIEWS, len(common))).indices] = True
    part = scene.of_views(wanted & scene.views.registered & (common > 0)).cleaned()
    some = torch.zeros(len(part.points), dtype=torch.bool)
    some[thin(torch.arange(len(part.points)), POINTS)] = True
    return replace(part, accepted=part.accepted & some[part.observations.point]).trimmed()


def _gravity(scene: Scene, stated: Capture) -> Survey:
    """That of the views of a scene."""
    row = {name: i for i, name in enumerate(stated.names)}
    rows = [row[name] for name in scene.views.names]
    return replace(
        Survey.empty(scene.views.names),
        down_in_cam=stated.down_in_cam[rows],
        down_sigma=stated.down_sigma[rows],
        down_image=torch.arange(len(rows)),
    )
