"""A survey in the adjustment of an alignment: its marks become points, its measurements terms."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchrefrac.bundle import CenterPrior, GravityPrior, HeightPrior, KnownPoints, ScaleBars, Term, Waterline
from torchrefrac.scene import Alignment, Survey, SurveyError

MAX_DISAGREEMENT_DEG = 45.0


def with_marks(alignment: Alignment, survey: Survey) -> Alignment:
    """The marks of the survey are the last points, at the origin where no position is known."""
    count, k = len(alignment.points), len(survey.mark_names)
    positions = alignment.points.new_zeros(k, 3)
    positions[survey.known_mark] = survey.known_position
    return replace(
        alignment,
        points=torch.cat((alignment.points, positions)),
        colors=torch.cat((alignment.colors, alignment.colors.new_full((k, 3), 255))),
        image=torch.cat((alignment.image, survey.mark_image)),
        point=torch.cat((alignment.point, count + survey.mark)),
        pixels=torch.cat((alignment.pixels, survey.mark_pixels)),
    )


def known_marks(survey: Survey) -> Tensor:
    """Which marks (k) have a known position."""
    known = torch.zeros(len(survey.mark_names), dtype=torch.bool)
    known[survey.known_mark] = True
    return known


def check_vertical(alignment: Alignment, survey: Survey) -> None:
    """Raise SurveyError where measured gravity is nowhere near the negative z axis of the alignment."""
    if not len(survey.down_image):
        return
    predicted = -alignment.rotation[survey.down_image][:, :, 2]
    angle = (predicted * survey.down_in_cam).sum(dim=-1).clamp(-1.0, 1.0).acos().rad2deg().median()
    if float(angle) > MAX_DISAGREEMENT_DEG:
        raise SurveyError(
            f"down_in_cam of the survey and the z axis of the alignment disagree by {float(angle):.0f} degrees (median "
            "of the images), but z must point up where gravity is used; level the alignment first"
        )


def survey_terms(survey: Survey, image_slot: Tensor, mark_slot: Tensor, plane: Tensor) -> Sequence[Term]:
    """The measurements as terms.

    image_slot (m) and mark_slot (k): the numbers of images and marks in the adjustment, -1 for those that take no part,
    whose measurements are left out. plane (m): the water plane of each image; a mark on the waterline lies in that of
    the first image that shows it.
    """
    down, height, center = (
        _present(image_slot, rows) for rows in (survey.down_image, survey.height_image, survey.center_image)
    )
    known, waterline = _present(mark_slot, survey.known_mark), _present(mark_slot, survey.waterline_mark)
    bars = (mark_slot[survey.bar_from] >= 0) & (mark_slot[survey.bar_to] >= 0)
    terms: list[Term] = []
    if len(down):
        image = image_slot[survey.down_image[down]]
        terms.append(GravityPrior(survey.down_in_cam[down], survey.down_sigma[down], image))
    if len(height):
        image = image_slot[survey.height_image[height]]
        terms.append(HeightPrior(image, survey.height[height], survey.height_sigma[height]))
    if len(center):
        image = image_slot[survey.center_image[center]]
        terms.append(CenterPrior(image, survey.center[center], survey.center_information[center]))
    if len(known):
        point = mark_slot[survey.known_mark[known]]
        terms.append(KnownPoints(point, survey.known_position[known], survey.known_information[known]))
    if len(waterline):
        mark = survey.waterline_mark[waterline]
        image = survey.mark_image[torch.searchsorted(survey.mark, mark)]
        terms.append(Waterline(mark_slot[mark], plane[image], survey.waterline_sigma[waterline]))
    if bool(bars.any()):
        ends = mark_slot[survey.bar_from[bars]], mark_slot[survey.bar_to[bars]]
        terms.append(ScaleBars(*ends, survey.bar_length[bars], survey.bar_sigma[bars]))
    return terms


def _present(slot: Tensor, of: Tensor) -> Tensor:
    """The rows of measurements of images or marks `of` that take part."""
    return (slot[of] >= 0).nonzero()[:, 0]
