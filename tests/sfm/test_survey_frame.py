"""What was measured on site: positions of cameras that a capture states, ground control, scale bars."""

from dataclasses import replace

import pytest
import torch

from tests.sfm.test_reconstruct_sparse import reconstruct
from torchrefrac.evaluate.survey_consistency import position_contradictions
from torchrefrac.geometry import Similarity, align_above_plane, heading_rotation
from torchrefrac.scene import Survey
from torchrefrac.sfm.frame import transformed
from torchrefrac.sfm.survey_frame import SurveyFrame, placed_by_survey

LEVEL = 420.0  # of the water where positions count from
in_water_and_air = pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])


def positioned(survey, draw, sigma=0.01):
    """The survey with the positions of its cameras, with errors of sigma, where the water stands at LEVEL."""
    true = survey.basin.center + torch.tensor((0.0, 0.0, LEVEL))
    error = torch.full_like(true, sigma)
    position = true + error * draw.normal(*true.shape)
    return replace(survey, capture=replace(survey.capture, position=position, position_sigma=error))


def placed(scene, capture):
    """The scene in the frame of the positions of a capture, and these."""
    return placed_by_survey(scene, capture, Survey.empty(capture.names).beside(capture))


def contradicted(scene):
    return position_contradictions(scene, scene.assessment.surveyed)


@pytest.fixture
def moved_scene(draw):
    """`moved_scene(survey)`: the true scene with another heading, place and scale."""

    def make(survey):
        turn = heading_rotation(torch.tensor(2.5, dtype=torch.float64))
        shift = torch.tensor((70.0, -30.0, 0.0 if survey.basin.index_ratio > 1.0 else 9.0), dtype=torch.float64)
        return transformed(survey.scene(with_points=True), Similarity(torch.tensor(0.3).double(), turn, shift))

    return make


@in_water_and_air
def test_the_scene_comes_to_stand_where_positions_say(survey_of, moved_scene, draw, index_ratio):
    survey = positioned(survey_of(cameras=5, index_ratio=index_ratio), draw, 1e-6)

    scene, frame = placed(moved_scene(survey), survey.capture)

    wet = index_ratio > 1.0
    lift = torch.tensor((0.0, 0.0, 0.0 if wet else LEVEL))
    torch.testing.assert_close(scene.views.center, survey.basin.center + lift, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(scene.points, survey.basin.points + lift, rtol=0.0, atol=1e-4)
    assert frame.level == pytest.approx(LEVEL if wet else 0.0, abs=1e-4)
    torch.testing.assert_close(frame.used.center, scene.views.center, rtol=0.0, atol=1e-4)


def test_one_wrong_position_does_not_move_the_others(survey_of, moved_scene, draw):
    survey = positioned(survey_of(cameras=6), draw)
    wrong = survey.capture.position.clone()
    wrong[2, 0] += 50.0

    scene, _ = placed(moved_scene(survey), replace(survey.capture, position=wrong))

    assert (scene.views.center - survey.basin.center).norm(dim=-1).max() < 0.3


def test_two_positions_and_those_within_their_errors_place_nothing(survey_of, moved_scene, draw):
    survey = positioned(survey_of(cameras=5), draw)
    few = survey.capture.position_sigma.clone()
    few[2:] = torch.inf
    vague = torch.full_like(few, 500.0)

    for sigma in (few, vague):
        assert placed(moved_scene(survey), replace(survey.capture, position_sigma=sigma)) is None


@in_water_and_air
def test_a_reconstruction_stands_in_the_frame_of_the_positions_with_the_water_at_zero(survey_of, draw, index_ratio):
    survey = survey_of(cameras=6, points=150, noise=0.2, gravity_error_deg=0.5, index_ratio=index_ratio)
    survey = positioned(survey, draw, 0.1)

    scene = reconstruct(survey)

    lowered = scene.assessment.lowered_by
    assert lowered == pytest.approx(LEVEL if index_ratio > 1.0 else 0.0, abs=0.2)
    off = scene.views.center + torch.tensor((0.0, 0.0, lowered)) - survey.capture.position
    assert off.norm(dim=-1).square().mean().sqrt() < 0.3
    assert contradicted(scene) == ()


def test_precise_positions_make_up_for_poor_pixels(survey_of, draw):
    survey = survey_of(cameras=8, points=60, noise=1.5, gravity_error_deg=0.5)

    without, with_them = (reconstruct(each) for each in (survey, positioned(survey, draw, 0.005)))

    error = []
    for scene in (without, with_them):
        change = align_above_plane(scene.views.center, survey.basin.center)
        error.append(float((change.apply(scene.views.center) - survey.basin.center).norm(dim=-1).mean()))
    assert error[1] < 0.5 * error[0]


def test_a_position_that_most_contradict_is_named_and_left_out(survey_of, draw):
    survey = positioned(survey_of(cameras=8, points=150, noise=0.1, gravity_error_deg=0.2), draw)
    wrong = survey.capture.position.clone()
    wrong[3, 1] += 5.0
    survey = replace(survey, capture=replace(survey.capture, position=wrong))

    scene = reconstruct(survey)

    (found,) = contradicted(scene)
    assert found.code == "position_contradicts"
    assert found.images == (survey.capture.names[3],)
    assert (scene.views.center - survey.basin.center).norm(dim=-1).max() < 0.1


def test_a_lowered_survey_remembers_the_level():
    survey = replace(Survey.empty("ab"), center=torch.zeros(2, 3).double())

    twice = SurveyFrame(survey, survey, 0).lowered(3.0).lowered(-1.0)

    assert twice.level == 2.0
    assert twice.used.center[:, 2].tolist() == twice.stated.center[:, 2].tolist() == [-2.0, -2.0]
