"""A model in a frame of its own, brought into that of a survey."""

from dataclasses import replace

import pytest
import torch

from tests.planted_reconstructions import plant_reconstruction
from torchrefrac.geometry import Similarity, so3_exp
from torchrefrac.scene import Survey, SurveyError
from torchrefrac.scene.survey import ControlPoint, SurveyedImage, resolve
from torchrefrac.sfm import placed_in_survey, upright
from torchrefrac.sfm.frame import moved, transformed

SIGMA = 0.02
KNOWN = (SIGMA**-2 * torch.eye(3, dtype=torch.float64)).tolist()
ELSEWHERE = Similarity(
    torch.tensor(0.037).double(), so3_exp(torch.tensor((1.1, -0.7, 2.0)).double()), torch.tensor((5.0, -3, 11)).double()
)


@pytest.fixture
def truth(make_basin, draw):
    """Seven cameras and 80 points."""
    return plant_reconstruction(make_basin(cameras=7, points=80, seen_by=3), draw).truth


def survey_of(truth, centers=(), gravity=(), control=(), change=None):
    """Of the cameras and points with these numbers. change: what positions of control points become."""
    views, seen = truth.views, truth.observations
    images = {
        name: SurveyedImage(
            down=((-views.rotation[i, :, 2]).tolist(), 0.01) if i in gravity else None,
            center=(views.center[i].tolist(), KNOWN) if i in centers else None,
        )
        for i, name in enumerate(views.names)
    }
    points = {}
    for i in control:
        of_point = seen[seen.point == i]
        names = [views.names[view] for view in of_point.view.tolist()]
        position = truth.points[i] if change is None else change(truth.points[i])
        pixels = dict(zip(names, of_point.pixels.tolist(), strict=True))
        points[f"m{i}"] = ControlPoint(pixels, (position.tolist(), KNOWN))
    return resolve(images, points, [], views.names)


def assert_same_cameras(scene, truth, within=1e-6):
    torch.testing.assert_close(scene.views.center, truth.views.center, rtol=0.0, atol=within)
    torch.testing.assert_close(scene.views.rotation, truth.views.rotation, rtol=0.0, atol=within)


@pytest.mark.parametrize(
    "known",
    [
        {"centers": range(7)},
        {"centers": (0, 2, 5)},
        {"centers": (1, 4), "gravity": (3,)},
        {"centers": (1, 4)},
        {"control": range(6)},
    ],
    ids=["centres", "three centres", "two centres and gravity", "two centres and the water", "control"],
)
def test_a_model_anywhere_comes_to_where_the_survey_has_it_and_its_water_goes_along(truth, known):
    placed = placed_in_survey(moved(truth, ELSEWHERE), survey_of(truth, **known))

    assert_same_cameras(placed.scene, truth)
    torch.testing.assert_close(placed.scene.points, truth.points, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(placed.scene.interfaces.normal, truth.interfaces.normal, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(placed.scene.interfaces.offset, truth.interfaces.offset, rtol=0.0, atol=1e-6)
    assert float(placed.change.scale) == pytest.approx(1.0 / 0.037)
    assert placed.turn_deg == pytest.approx(float(torch.tensor((1.1, -0.7, 2.0)).norm().rad2deg()), abs=1e-3)


def test_water_that_is_in_place_stays(truth):
    elsewhere = transformed(truth, ELSEWHERE)

    placed = placed_in_survey(elsewhere, survey_of(truth, range(7)), water_is_in_place=True)

    assert_same_cameras(placed.scene, truth)
    assert placed.scene.interfaces is elsewhere.interfaces


@pytest.mark.parametrize("wrong", [0.0, 30.0])
def test_a_model_that_stands_right_stays_to_the_last_bit(truth, wrong):
    survey = survey_of(truth, range(7), control=range(4))
    survey = replace(
        survey, center=survey.center.index_add(0, torch.tensor([2]), torch.tensor([[wrong, 0.0, 0.0]]).double())
    )

    placed = placed_in_survey(truth, survey)

    assert placed.scene is truth
    assert placed.change is None


def test_poses_that_know_nothing_of_the_water_are_no_other_frame(make_basin, draw):
    planted = plant_reconstruction(make_basin(cameras=7, points=80, seen_by=3), draw)
    given = planted.as_of_a_pinhole(draw)

    assert placed_in_survey(given, survey_of(planted.truth, range(7), control=range(4))).scene is given


def test_one_wrong_position_does_not_move_the_others(truth):
    survey = survey_of(truth, range(7))
    survey = replace(
        survey, center=survey.center.index_add(0, torch.tensor([2]), torch.tensor([[50.0, 0.0, 0.0]]).double())
    )

    assert_same_cameras(placed_in_survey(moved(truth, ELSEWHERE), survey).scene, truth)


def test_too_few_positions_are_refused_where_the_model_is_elsewhere(truth):
    with pytest.raises(SurveyError, match=r"2 of them do not say how it is turned .* give 3 that are not on a line"):
        placed_in_survey(transformed(truth, ELSEWHERE), survey_of(truth, (1, 4)), water_is_in_place=True)


def exchanged(point):
    return point[[1, 0, 2]]


def test_exchanged_axes_of_control_points_are_named(truth):
    survey = survey_of(truth, range(7), control=range(5), change=exchanged)

    for given in (truth, moved(truth, ELSEWHERE)):
        with pytest.raises(SurveyError, match="position of marks in the survey fits far better with x and y exchanged"):
            placed_in_survey(given, survey)


def test_exchanged_axes_of_all_positions_are_named(truth):
    survey = survey_of(truth, range(7), gravity=range(7))

    with pytest.raises(SurveyError, match="center of images in the survey fits far better with x and y exchanged"):
        placed_in_survey(truth, replace(survey, center=survey.center[:, [1, 0, 2]]))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda point: 0.3048 * point, "units that differ by a factor of 3.281"),
        (lambda point: point + point.new_tensor((5e5, 4e6, 0.0)), r"frames that are 4.03\de\+06 apart"),
    ],
)
def test_control_in_another_unit_or_frame_is_named(truth, change, told):
    survey = survey_of(truth, range(7), control=range(6), change=change)

    with pytest.raises(SurveyError, match=f"position of marks and center of images in the survey are in {told}"):
        placed_in_survey(truth, survey)


def test_gravity_puts_a_model_upright_whose_place_nothing_fixes(truth):
    given = transformed(truth, ELSEWHERE)
    survey = survey_of(truth, gravity=(0, 3))

    found = upright(placed_in_survey(given, survey), survey)

    down = -found.scene.views.rotation[:, :, 2]
    torch.testing.assert_close(down, -truth.views.rotation[:, :, 2], rtol=0.0, atol=1e-9)
    assert found.scene.interfaces is given.interfaces


def test_a_survey_that_says_nothing_of_a_frame_puts_nothing_upright(truth):
    for survey in (Survey.empty(truth.views.names), survey_of(truth, (1, 4))):
        assert upright(placed_in_survey(truth, survey), survey) is None
