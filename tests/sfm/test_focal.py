"""Focal lengths that were stated grossly wrong, and those that nobody knows."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.scene import Assessment, Cameras
from torchrefrac.sfm import SfmOptions, better_focal, with_likely_focals


@pytest.fixture
def stated(survey_of):
    """`stated(factor)`: a survey whose capture states focal lengths that are so many times the true ones."""

    def make(factor):
        survey = survey_of(cameras=3, points=200, noise=0.1, outliers=0.05, gravity_error_deg=0.3)
        cameras = survey.capture.cameras
        wrong = Cameras.of([replace(cameras[0], focal=factor * cameras[0].focal)])
        return replace(survey, capture=replace(survey.capture, cameras=wrong))

    return make


def _judged(survey, scene):
    return better_focal(scene, survey.capture, survey.pairs(), survey.features(), SfmOptions())


@pytest.mark.parametrize("factor", [0.2, 10.0])
def test_where_nothing_could_be_registered_the_right_focal_length_is_found(stated, factor):
    survey = stated(factor)
    found = _judged(survey, survey.tracks())
    assert found is not None
    assert abs(found[0] + math.log(factor)) < 3.0 * found[1] < 0.5


def test_right_focal_lengths_are_not_doubted_where_nothing_could_be_registered(stated):
    survey = stated(1.0)
    assert _judged(survey, survey.tracks()) is None


def test_gravity_with_axes_mixed_up_is_not_taken_for_a_wrong_focal_length(stated):
    survey = stated(1.0)
    down = survey.capture.down_in_cam * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    survey = replace(survey, capture=replace(survey.capture, down_in_cam=down))
    assert _judged(survey, survey.tracks()) is None
    assert _judged(survey, survey.scene(with_points=True)) is None


def test_a_scene_that_agrees_with_gravity_is_not_looked_into(stated):
    survey = stated(4.0)
    assert _judged(survey, survey.scene(with_points=True)) is None


def test_with_a_grossly_wrong_focal_length_nothing_else_is_judged(stated):
    survey = stated(4.0)
    upside_down = survey.capture.down_in_cam * torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
    scene = replace(survey.scene(with_points=True), assessment=Assessment(wished={"focal": (-math.log(4.0), 0.02)}))
    (found,) = contradictions(scene, replace(survey.capture, down_in_cam=upside_down))
    assert found.code == "intrinsics_contradict"
    assert "near 667 px" in found.message


def _likely(survey, sigma=0.3, **changes):
    cameras = replace(survey.capture.cameras, focal_sigma=torch.tensor([sigma], dtype=torch.float64))
    capture = replace(survey.capture, cameras=cameras, **changes)
    known = survey.pairs(), survey.features(), survey.basin.index_ratio, SfmOptions()
    return capture, with_likely_focals(capture, *known)


@pytest.mark.parametrize("factor", [0.45, 2.2])
def test_a_focal_length_that_nobody_knows_is_found_before_anything_is_placed(stated, factor):
    survey = stated(factor)

    given, found = _likely(survey)

    wanted = survey.basin.lens.focal
    assert abs(float((found.cameras.focal[0] / wanted).log()[0])) < 0.15
    assert found.cameras.stated is given.cameras  # about which the prior is
    assert torch.equal(found.cameras.focal_sigma, given.cameras.focal_sigma)


def test_a_focal_length_that_is_known_or_cannot_be_found_stays(stated):
    survey = stated(2.0)
    unlevelled = torch.full_like(survey.capture.down_sigma, math.inf)

    for sigma, changes in ((0.0, {}), (0.05, {}), (0.3, {"down_sigma": unlevelled})):
        given, found = _likely(survey, sigma, **changes)
        assert found is given
