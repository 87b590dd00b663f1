"""What was measured on site: positions of cameras that a capture states, ground control, scale bars."""

import re
from dataclasses import replace

import pytest
import torch

from tests.sfm.test_reconstruct_sparse import Prepared, reconstruct
from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.evaluate.survey_consistency import position_contradictions
from torchrefrac.evaluate.survey_metrics import survey_metrics
from torchrefrac.geometry import Similarity, align_above_plane, heading_rotation
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Survey, with_measured
from torchrefrac.scene.survey import ControlPoint, ScaleBar, SurveyedImage, resolve
from torchrefrac.sfm import reconstruct_sparse
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
    return position_contradictions(scene, scene.assessment.surveyed, scene.assessment.lowered_by)


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
    images = {name: SurveyedImage(center=([0.0, 0.0, 0.0], torch.eye(3).tolist())) for name in "ab"}
    survey = resolve(images, {}, [], "ab")

    twice = SurveyFrame(survey, survey, 0).lowered(3.0).lowered(-1.0)

    assert twice.level == 2.0
    assert twice.used.center[:, 2].tolist() == twice.stated.center[:, 2].tolist() == [-2.0, -2.0]


def control_of(survey, draw, change=lambda point: point, bars=(), count=6):
    """The first points of the basin as ground control points, with clicks that err by half a pixel, and with positions
    unless there are scale bars, which are between these points."""
    pixels, seen = survey.basin.project()
    clicks = pixels[:, :count] + 0.5 * draw.normal(len(pixels), count, 2)
    information = (1e4 * torch.eye(3)).tolist()
    points = {}
    for i in range(count):
        where = {name: clicks[view, i].tolist() for view, name in enumerate(survey.capture.names) if seen[view, i]}
        known = None if bars else (change(survey.basin.points[i]).tolist(), information)
        points[f"m{i}"] = ControlPoint(where, known)
    lengths = [(i, j, float((survey.basin.points[i] - survey.basin.points[j]).norm())) for i, j in bars]
    return resolve({}, points, [ScaleBar(f"m{i}", f"m{j}", far, 0.01) for i, j, far in lengths], survey.capture.names)


def reconstruct_with(survey, stated):
    """From the matches and what was measured on site."""
    given = Prepared.of(survey)
    return reconstruct_sparse(
        given.scene, given.capture, given.pairs, given.initializer, given.options, given.generator, SilentRecorder(),
        survey=stated,
    )  # fmt: skip


TURNED = heading_rotation(torch.tensor(0.7).double())
PLACE = torch.tensor((500.0, 200.0, LEVEL)).double()


def test_ground_control_alone_gives_the_scene_its_place_and_is_no_tie_point(survey_of, draw):
    survey = survey_of(cameras=6, points=150, noise=0.1, gravity_error_deg=0.3)

    scene = reconstruct_with(survey, control_of(survey, draw, lambda point: TURNED @ point + PLACE))

    lowered = scene.assessment.lowered_by
    assert lowered == pytest.approx(LEVEL, abs=0.2)
    wanted = survey.basin.center @ TURNED.T + PLACE - torch.tensor((0.0, 0.0, lowered))
    assert float((scene.views.center - wanted).norm(dim=-1).max()) < 0.3
    assert len(scene.points) <= 150
    assert len(scene.assessment.point_sigma) == len(scene.points)
    known = scene.assessment.surveyed
    assert bool(known.placed.all())
    assert float(known.off.norm(dim=-1).max()) < 0.6
    assert contradicted(scene) == ()
    found = survey_metrics(known, "cm", lowered)
    assert found["marks"]["m2"] == pytest.approx((TURNED @ survey.basin.points[2] + PLACE).tolist(), abs=0.1)
    assert found["mark_rms_cm"] == pytest.approx(float(known.off.norm(dim=-1).square().mean().sqrt()))
    assert list(found["mark_residuals_cm"]) == list(found["marks"]) == [f"m{i}" for i in range(6)]


def test_scale_bars_give_the_scene_its_scale_and_nothing_else(survey_of, draw):
    survey = survey_of(cameras=5, points=150, noise=0.1, gravity_error_deg=0.3)
    wrong = replace(survey, capture=replace(survey.capture, height=2.0 * survey.capture.height))

    scene = reconstruct_with(wrong, control_of(survey, draw, bars=((0, 1), (2, 3), (4, 5))))

    assert scene.assessment.lowered_by is None
    torch.testing.assert_close(scene.views.center[0, :2], torch.zeros(2).double(), rtol=0.0, atol=1e-9)
    change = align_above_plane(scene.views.center, survey.basin.center)
    assert float(change.scale) == pytest.approx(1.0, abs=0.003)
    (found,) = [each for each in contradictions(scene, wrong.capture) if each.code == "height_contradicts"]
    assert re.match(r"heights are stated to be (1.99|2.0)\d* times", found.message)


def test_ground_control_with_exchanged_axes_is_named_and_left_out(survey_of, draw):
    survey = positioned(survey_of(cameras=6, points=150, noise=0.1, gravity_error_deg=0.3), draw)
    lift = torch.tensor((0.0, 0.0, LEVEL))

    scene = reconstruct_with(survey, control_of(survey, draw, lambda point: (point + lift)[[1, 0, 2]]))

    (found,) = contradicted(scene)
    assert found.code == "control_contradicts"
    assert "position of marks in the survey fits far better with x and y exchanged" in found.message
    assert float((scene.views.center - survey.basin.center).norm(dim=-1).max()) < 0.2


def test_two_control_points_place_nothing_and_are_named(survey_of, draw):
    survey = survey_of(cameras=5, points=150, noise=0.1)

    scene = reconstruct_with(survey, control_of(survey, draw, count=2))

    assert scene.assessment.lowered_by is None
    (found,) = contradicted(scene)
    assert (
        "do not say where the scene is: give 3 or more that are apart; these positions were not used" in found.message
    )


def test_a_click_that_is_wrong_leaves_the_scene_right(survey_of, draw):
    survey = survey_of(cameras=6, points=150, noise=0.1, gravity_error_deg=0.3)
    stated = control_of(survey, draw, lambda point: TURNED @ point + PLACE)
    clicks = stated.control_pixels.clone()
    clicks[0] += 40.0

    scene = reconstruct_with(survey, replace(stated, control_pixels=clicks))

    wanted = survey.basin.center @ TURNED.T + PLACE - torch.tensor((0.0, 0.0, scene.assessment.lowered_by))
    assert float((scene.views.center - wanted).norm(dim=-1).max()) < 0.3
    assert scene.assessment.surveyed.placed.tolist()[1:] == [True] * 5


def test_points_on_the_waterline_take_part(survey_of, draw):
    survey = positioned(survey_of(cameras=6, points=150, noise=0.1, gravity_error_deg=0.3), draw, 0.05)
    spot = torch.tensor((5.0, -8.0, 0.0)).double()
    pixels, _ = survey.basin.cameras.project(spot)
    seen = {name: at.tolist() for name, at in zip(survey.capture.names, pixels + draw.normal(6, 2), strict=True)}
    stated = resolve({}, {"w": ControlPoint(seen, waterline=1e-3)}, [], survey.capture.names)

    scene = reconstruct_with(survey, stated)

    (where,) = scene.assessment.surveyed.control
    assert abs(float(where[2])) < 3e-3
    assert scene.assessment.lowered_by == pytest.approx(LEVEL, abs=0.1)
    torch.testing.assert_close(where[:2], spot[:2], rtol=0.0, atol=0.2)


def test_a_capture_takes_in_what_a_survey_measured_of_its_images(survey_of):
    survey = survey_of(cameras=4)
    information = torch.diag(torch.tensor((4.0, 1.0, 0.25))).tolist()
    images = {"2.jpg": SurveyedImage(([0.0, 0.0, 1.0], 0.01), (33.0, 0.1), ([1.0, 2.0, 3.0], information))}
    stated = resolve(images, {}, [], survey.capture.names)

    capture = with_measured(survey.capture, stated)

    assert capture.down_in_cam[2].tolist() == [0.0, 0.0, 1.0]
    assert (float(capture.down_sigma[2]), float(capture.height[2]), float(capture.height_sigma[2])) == (0.01, 33.0, 0.1)
    assert capture.has_height.tolist() == [True, False, True, False]
    assert (capture.position[2].tolist(), capture.position_sigma[2].tolist()) == ([1.0, 2.0, 3.0], [0.5, 1.0, 2.0])
    assert torch.equal(capture.down_in_cam[:2], survey.capture.down_in_cam[:2])
    beside = stated.beside(capture)
    assert len(beside.down_image) == 0
    assert beside.center_image.tolist() == [2]
    assert torch.equal(beside.center_information, stated.center_information)
    assert with_measured(survey.capture, Survey.empty(survey.capture.names)) is survey.capture


def test_ground_control_in_another_datum_is_named_and_left_out(survey_of, draw):
    survey = positioned(survey_of(cameras=6, points=150, noise=0.1, gravity_error_deg=0.3), draw)
    lift = torch.tensor((0.0, 0.0, LEVEL - 46.5))

    scene = reconstruct_with(survey, control_of(survey, draw, lambda point: point + lift))

    (found,) = contradicted(scene)
    assert found.code == "control_contradicts"
    assert re.search(r"count from levels that are 46.\d+ apart, as of two datums: give both in one", found.message)
    assert scene.assessment.lowered_by == pytest.approx(LEVEL, abs=0.1)
