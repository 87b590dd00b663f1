"""Bundle adjustment of the growing scene."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.bundle import BundleOptions
from torchrefrac.geometry import so3_exp
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.sfm import Adjustment, adjust

SOLVER = LevenbergMarquardtOptions(function_tolerance=1e-14)
OPTIONS = BundleOptions(loss="squared", solver=SOLVER)


@pytest.fixture
def disturbed(draw):
    """`disturbed(survey)`: the true scene with its cameras and points a little off."""

    def make(survey):
        scene = survey.scene(with_points=True)
        rotation = so3_exp(0.003 * draw.normal(*scene.views.center.shape)) @ scene.views.rotation
        center = scene.views.center + 0.2 * draw.normal(*scene.views.center.shape)
        points = scene.points + 0.3 * draw.normal(*scene.points.shape)
        return replace(scene, views=scene.views.at(rotation, center), points=points)

    return make


@pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])
def test_cameras_and_points_come_to_agree_with_the_images(survey_of, rules_of, disturbed, index_ratio):
    survey = survey_of(index_ratio=index_ratio, land=10)
    scene = disturbed(survey)
    assert scene.errors().amax() > 1.0

    adjusted, outcome = adjust(scene, rules_of(survey, OPTIONS))

    assert adjusted.errors().amax() < 1e-4
    assert outcome.report.status == "converged"
    assert outcome.kind is Adjustment.CONVERGED
    assert str(outcome) == "the adjustment converged"


def test_an_adjustment_that_is_stopped_says_so(survey_of, rules_of, disturbed):
    survey = survey_of()

    _, outcome = adjust(disturbed(survey), rules_of(survey, replace(OPTIONS, solver=replace(SOLVER, max_iterations=1))))

    assert outcome.kind is Adjustment.STOPPED
    assert str(outcome) == "the adjustment stopped before it converged"
    assert not outcome.done


def test_steps_are_passed_on_as_they_are_taken(survey_of, rules_of, disturbed):
    survey, steps = survey_of(), []

    _, outcome = adjust(disturbed(survey), rules_of(survey, OPTIONS), lambda *step: steps.append(step))

    numbers = [iteration for iteration, _, _ in steps]
    assert numbers == sorted(set(numbers))
    assert 1 <= numbers[-1] <= outcome.report.iterations
    assert [cost for _, cost, _ in steps] == outcome.report.costs[1:]


def test_what_is_not_registered_or_has_no_accepted_observation_stays_as_it_is(survey_of, rules_of, disturbed):
    survey = survey_of()
    scene, seen = disturbed(survey), survey.seen
    accepted = scene.accepted & (seen.point % 7 != 3) & (seen.view != 2)
    views = replace(scene.views, registered=torch.tensor([True, True, False, True]))
    scene = replace(scene, views=views, accepted=accepted)

    adjusted, _ = adjust(scene, rules_of(survey, OPTIONS))

    moved = (adjusted.points != scene.points).any(dim=-1)
    assert torch.equal(moved, torch.bincount(seen.point[accepted], minlength=60) > 0)
    assert torch.equal((adjusted.views.center != scene.views.center).any(dim=-1), views.registered)
    assert torch.equal(adjusted.accepted, scene.accepted)


def test_a_view_of_which_no_observation_is_left_does_not_keep_the_others_from_being_adjusted(
    survey_of, rules_of, disturbed
):
    survey = survey_of()
    scene, seen = disturbed(survey), survey.seen
    scene = replace(scene, accepted=scene.accepted & (seen.view != 2))

    adjusted, _ = adjust(scene, rules_of(survey, OPTIONS))

    both = scene.accepted & (torch.bincount(seen.point[scene.accepted], minlength=60) >= 2)[seen.point]
    assert adjusted.errors()[both].amax() < 1e-4


def test_poses_that_are_fixed_stay_to_the_last_bit_while_points_move(survey_of, rules_of, disturbed):
    survey = survey_of()
    scene = replace(disturbed(survey), views=survey.scene().views)

    adjusted, _ = adjust(scene, replace(rules_of(survey, OPTIONS), fixed_poses=True))

    assert torch.equal(adjusted.views.rotation, survey.basin.rotation)
    assert torch.equal(adjusted.views.center, survey.basin.center)
    torch.testing.assert_close(adjusted.points, survey.basin.points, rtol=0.0, atol=1e-5)


def test_through_water_gravity_is_a_prior(survey_of, rules_of, disturbed):
    survey = survey_of(noise=1.0)
    sure = replace(survey, capture=replace(survey.capture, down_sigma=torch.full_like(survey.capture.height, 1e-8)))

    adjusted, _ = adjust(disturbed(survey), rules_of(sure, OPTIONS))

    torch.testing.assert_close(-adjusted.views.rotation[..., 2], survey.capture.down_in_cam, rtol=0.0, atol=1e-6)
