"""A survey in the adjustment of a scene: ground control becomes points, measurements become terms."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Int
from torch import Tensor

from torchrefrac.bundle import (
    CenterPrior,
    GravityPrior,
    HeightPrior,
    KnownPoints,
    ScaleBars,
    Term,
    WaterLevels,
    Waterline,
    WaterSlope,
)
from torchrefrac.scene import Observations, Part, Scene, Survey, SurveyError
from torchrefrac.sfm.stated_levels import SLOPES, StatedLevels, places_of_levels, surface_of_levels

MAX_DISAGREEMENT_DEG = 45.0
CLICK = 0.5
"""Pixels by which somebody who points at a control point errs in a coordinate."""


def with_control(scene: Scene, survey: Survey, pixel_sigma: float = CLICK) -> Scene:
    """The ground control points of the survey are the last points, white, at the origin where no position is known.
    pixel_sigma: of keypoints, than which their pixels are noisier by as much as somebody who points errs more."""
    seen, count, k = scene.observations, len(scene.points), len(survey.control_names)
    positions = scene.points.new_zeros(k, 3)
    positions[survey.known_control] = survey.known_position
    noise, of_clicks = seen.noise, max(CLICK / pixel_sigma, 1.0)
    if noise is not None or (k and of_clicks > 1.0):
        ones, every = torch.ones_like(seen.pixels[:, 0]), torch.full_like(survey.control_pixels[:, 0], of_clicks)
        noise = torch.cat((ones if noise is None else noise, every))
    return replace(
        scene,
        points=torch.cat((scene.points, positions)),
        colors=torch.cat((scene.colors, scene.colors.new_full((k, 3), 255))),
        placed=torch.cat((scene.placed, scene.placed.new_zeros(k))),
        dry=None if scene.dry is None else torch.cat((scene.dry, scene.dry.new_zeros(k))),
        observations=Observations(
            torch.cat((seen.view, survey.control_image)),
            torch.cat((seen.point, count + survey.control)),
            torch.cat((seen.pixels, survey.control_pixels)),
            noise=noise,
        ),
        accepted=torch.cat((scene.accepted, scene.accepted.new_zeros(len(survey.control)))),
    )


def check_vertical(scene: Scene, survey: Survey) -> None:
    """Raise SurveyError where measured gravity is nowhere near the negative z axis of the scene."""
    if not len(survey.down_image):
        return
    predicted = -scene.views.rotation[survey.down_image][:, :, 2]
    angle = (predicted * survey.down_in_cam).sum(dim=-1).clamp(-1.0, 1.0).acos().rad2deg().median()
    if float(angle) > MAX_DISAGREEMENT_DEG:
        raise SurveyError(
            f"down_in_cam of the survey and the z axis of the reconstruction disagree by {float(angle):.0f} degrees "
            "(median of the images), but z must point up where gravity is used; level the reconstruction first"
        )


def survey_terms(survey: Survey, part: Part, ties: int) -> Sequence[Term]:
    """The measurements as terms of the adjustment of a part of a scene, whose points after the first `ties` are the
    ground control points.

    Measurements of what does not take part are left out. A control point on the waterline lies in the surface of the
    first view that shows it; levels are those of the surfaces of their epochs. Where they show the slope of the water,
    it departs from the horizontal by SLOPES.
    """
    image_slot = _slots(part.view, len(survey.names))
    slot = _slots(part.point, ties + len(survey.control_names))[ties:]
    terms: list[Term] = []
    rows, image = _present(image_slot, survey.down_image)
    if len(rows):
        terms.append(GravityPrior(survey.down_in_cam[rows], survey.down_sigma[rows], image, survey.up))
    rows, image = _present(image_slot, survey.height_image)
    if len(rows):
        terms.append(HeightPrior(image, survey.height[rows], survey.height_sigma[rows]))
    rows, image = _present(image_slot, survey.center_image)
    if len(rows):
        terms.append(CenterPrior(image, survey.center[rows], survey.center_information[rows]))
    rows, point = _present(slot, survey.known_control)
    if len(rows):
        terms.append(KnownPoints(point, survey.known_position[rows], survey.known_information[rows]))
    rows, point = _present(slot, survey.waterline_control)
    if len(rows):
        seen = part.scene.observations
        surface = part.scene.views.interface[seen.view[torch.searchsorted(seen.point, point)]]
        terms.append(Waterline(point, surface, survey.waterline_sigma[rows]))
    if len(survey.level):
        surface, places = surface_of_levels(survey, part.scene)[survey.level], places_of_levels(survey, part.scene)
        terms.append(WaterLevels(surface, places, survey.level_sigma))
        levels = StatedLevels.of(survey, part.scene)
        if levels.show_slope(part.scene):
            across = torch.linalg.cross(survey.up, torch.nn.functional.pad(levels.along, (0, 1)))
            axes = torch.stack((torch.linalg.cross(across, survey.up), across))
            terms.append(WaterSlope(axes / axes.norm(dim=-1, keepdim=True), axes.new_tensor(SLOPES)))
    bars = (slot[survey.bar_from] >= 0) & (slot[survey.bar_to] >= 0)
    if bool(bars.any()):
        ends = slot[survey.bar_from[bars]], slot[survey.bar_to[bars]]
        terms.append(ScaleBars(*ends, survey.bar_length[bars], survey.bar_sigma[bars]))
    return terms


def _slots(ids: Int[Tensor, " k"], count: int) -> Int[Tensor, " n"]:
    """The number among `ids` of everything up to `count`; -1 for what is not there."""
    slots = torch.full((count,), -1, dtype=torch.long)
    slots[ids] = torch.arange(len(ids))
    return slots


def _present(slot: Int[Tensor, " n"], of: Int[Tensor, " k"]) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """The rows of measurements `of` views or points that take part, and the slots of these."""
    rows = (slot[of] >= 0).nonzero()[:, 0]
    return rows, slot[of[rows]]
