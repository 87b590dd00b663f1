"""Bundle adjustment of the growing model."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.bundle import BundleOptions
from torchrefrac.geometry import so3_exp
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.sfm.adjustment import adjust_model

OPTIONS = BundleOptions(loss="squared", solver=LevenbergMarquardtOptions(function_tolerance=1e-14))


@pytest.fixture
def disturbed(draw):
    """`disturbed(survey)`: the true model with its cameras and points a little off."""

    def make(survey):
        model = survey.model(with_points=True)
        return replace(
            model,
            rotation=so3_exp(0.003 * draw.normal(*model.center.shape)) @ model.rotation,
            center=model.center + 0.2 * draw.normal(*model.center.shape),
            points=model.points + 0.3 * draw.normal(*model.points.shape),
        )

    return make


@pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])
def test_cameras_and_points_come_to_agree_with_the_images(survey_of, disturbed, index_ratio):
    survey = survey_of(index_ratio=index_ratio, land=10)
    model = disturbed(survey)
    assert model.errors().amax() > 1.0

    adjusted, report = adjust_model(model, survey.capture, OPTIONS)

    assert adjusted.errors().amax() < 1e-4
    assert report.status == "converged"


def test_what_is_not_registered_or_has_no_active_observation_stays_as_it_is(survey_of, disturbed):
    survey = survey_of()
    model = disturbed(survey)
    idle = model.tracks.track % 7 == 3
    active = model.active & ~idle & (model.tracks.image != 2)
    model = replace(model, registered=torch.tensor([True, True, False, True]), active=active)

    adjusted, _ = adjust_model(model, survey.capture, OPTIONS)

    moved = (adjusted.points != model.points).any(dim=-1)
    assert torch.equal(moved, torch.bincount(model.tracks.track[active], minlength=60) > 0)
    assert torch.equal((adjusted.center != model.center).any(dim=-1), model.registered)
    assert torch.equal(adjusted.active, model.active)


def test_an_image_of_which_no_observation_is_left_does_not_keep_the_others_from_being_adjusted(survey_of, disturbed):
    survey = survey_of()
    model = disturbed(survey)
    model = replace(model, active=model.active & (model.tracks.image != 2))

    adjusted, _ = adjust_model(model, survey.capture, OPTIONS)

    both = model.active & (torch.bincount(model.tracks.track[model.active], minlength=60) >= 2)[model.tracks.track]
    assert adjusted.errors()[both].amax() < 1e-4


def test_through_water_gravity_is_a_prior(survey_of, disturbed):
    survey = survey_of(noise=1.0)
    sure = replace(survey.capture, down_sigma=1e-8)

    adjusted, _ = adjust_model(disturbed(survey), sure, OPTIONS)

    torch.testing.assert_close(-adjusted.rotation[..., 2], survey.capture.down_in_cam, rtol=0.0, atol=1e-6)


def test_in_air_gravity_takes_no_part(survey_of, disturbed):
    survey = survey_of(noise=1.0, index_ratio=1.0)
    sure = replace(survey.capture, down_sigma=1e-8)
    model = disturbed(survey)

    with_gravity, without = (adjust_model(model, capture, OPTIONS)[0] for capture in (sure, survey.capture))

    assert torch.equal(with_gravity.rotation, without.rotation)
