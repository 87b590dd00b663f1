"""Levels of the water that a survey states, and epochs between which the water rose."""

from dataclasses import replace

import pytest
import torch

from tests.sfm.test_levels import of_two_days  # noqa: F401 - a fixture
from tests.sfm.test_survey_frame import LEVEL, contradicted, positioned, reconstruct_with
from torchrefrac.evaluate.metrics import summarize
from torchrefrac.scene import SurveyError
from torchrefrac.scene.survey import ControlPoint, WaterMark, resolve
from torchrefrac.sfm.stated_levels import StatedLevels, check_levels


def levels(survey, *marks):
    return resolve({}, {}, [], survey.capture.names, marks)


@pytest.fixture
def river(survey_of, draw):
    """Cameras with positions whose common height is off by 0.05 cm or so."""
    return positioned(survey_of(cameras=6, points=150, noise=0.2, gravity_error_deg=0.3), draw, 0.1)


def test_a_level_takes_part_by_its_variance_and_the_rest_is_what_images_say_without_it(river):
    alone = reconstruct_with(river, levels(river))
    level, sigma = alone.assessment.lowered_by, alone.assessment.water_level_sigma
    assert level is not None
    assert sigma is not None
    stated = level + 0.03

    scene = reconstruct_with(river, levels(river, WaterMark("gauge", (None, None, stated), sigma)))

    found = summarize(scene)
    assert found["water_level_cm"] == pytest.approx(stated - 0.015, abs=0.006)
    assert found["water_level_sigma_cm"] == pytest.approx(sigma / 2**0.5, rel=0.1)
    gauge, images = found["water_level_from"]
    assert (gauge["source"], gauge["height"], gauge["sigma"]) == ("gauge", pytest.approx(stated), pytest.approx(sigma))
    assert gauge["weight_percent"] == pytest.approx(50.0, abs=8.0)
    assert images["height"] == pytest.approx(level, abs=0.015)
    assert images["sigma"] == pytest.approx(sigma, rel=0.2)
    assert gauge["weight_percent"] + images["weight_percent"] == pytest.approx(100.0)
    assert contradicted(scene) == ()


def test_a_level_that_images_contradict_is_named_and_not_used(river):
    scene = reconstruct_with(river, levels(river, WaterMark("gauge", (None, None, LEVEL + 3.0), 0.01)))

    (found,) = contradicted(scene)
    assert found.code == "water_level_contradicts"
    assert found.message.startswith("gauge states the water at 423 cm, ")
    assert "above where everything else has it" in found.message
    assert "it was not used" in found.message
    assert scene.assessment.lowered_by == pytest.approx(LEVEL, abs=0.2)
    (gauge, images) = summarize(scene)["water_level_from"]
    assert (gauge["weight_percent"], images["weight_percent"]) == (0.0, 100.0)


def test_a_level_without_positions_is_named(survey_of):
    survey = survey_of(cameras=5, points=150, noise=0.1)

    scene = reconstruct_with(survey, levels(survey, WaterMark("gauge", (None, None, 3.0), 0.01)))

    (found,) = contradicted(scene)
    assert "no positions that say where it is counted from" in found.message


def test_points_of_the_shore_are_one_source(river):
    marks = [WaterMark("shore", (x, 3.0, LEVEL + z), 0.02) for x, z in ((0.0, 0.01), (9.0, -0.01))]
    survey = levels(river, *marks, WaterMark("gauge", (None, None, LEVEL), 0.01))

    stated = StatedLevels.of(survey, river.tracks())

    assert survey.level_sources == ("shore", "gauge")
    torch.testing.assert_close(stated.height, torch.tensor((LEVEL, LEVEL)).double())
    torch.testing.assert_close(stated.sigma, torch.tensor((0.02 / 2**0.5, 0.01)).double())
    assert survey.of_levels(torch.tensor((False, True))).level.tolist() == [0]
    assert survey.lowered(LEVEL).level_position[:, 2].abs().max() < 0.02


def test_what_the_others_say_is_what_is_left_of_the_information():
    of = StatedLevels(
        *torch.tensor(([1.0, 9.0], [0.5, 1.0])).double(),
        torch.zeros(2).long(),
        torch.zeros(2, 2).double(),
        torch.zeros(2).bool(),
    )
    rest, spread = 2.0, 0.25
    weight = 1 / 0.5**2, 1 / spread**2
    level = torch.tensor([(weight[0] * 1.0 + weight[1] * rest) / sum(weight)]).double()
    sigma = torch.tensor([sum(weight) ** -0.5]).double()

    others = of.others(level, sigma, torch.tensor((True, False)))

    torch.testing.assert_close(others.height, torch.stack((torch.tensor(rest).double(), level[0])))
    torch.testing.assert_close(others.sigma, torch.stack((torch.tensor(spread).double(), sigma[0])))
    assert of.agree_with(level, sigma).tolist() == [True, False]


@pytest.mark.parametrize(
    "has_positions", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["in the map", "in a frame of its own"]
)
def test_two_epochs_have_two_levels_in_one_adjustment(of_two_days, draw, has_positions):  # noqa: F811
    rise, later = 3.0, (3, 4, 5)
    survey = of_two_days(rise, later)
    survey = positioned(survey, draw, 0.05) if has_positions else survey
    epoch = torch.tensor([int(image in later) for image in range(6)])
    survey = replace(survey, capture=replace(survey.capture, epochs=("may", "june"), epoch=epoch))

    scene = reconstruct_with(survey, levels(survey))

    metrics = summarize(scene)
    found, base = metrics["water_levels_cm"], LEVEL if has_positions else 0.0
    assert found["may"]["height"] == pytest.approx(base, abs=0.1)
    assert found["june"]["height"] == pytest.approx(base + rise, abs=0.1)
    assert 0.0 < found["june"]["sigma"] < 0.1
    assert scene.interfaces.offset[0] == 0.0
    assert scene.views.interface.tolist() == epoch.tolist()
    assert metrics["warnings"] == []
    error = (scene.points - survey.basin.points[scene.colors[:, 0].long()]).norm(dim=-1)
    assert not has_positions or float(error.median()) < 0.3


@pytest.mark.slow
def test_each_epoch_has_its_own_gauge(of_two_days, draw):  # noqa: F811
    survey = positioned(of_two_days(3.0, (3, 4, 5)), draw, 0.05)
    epoch = torch.tensor((0, 0, 0, 1, 1, 1))
    survey = replace(survey, capture=replace(survey.capture, epochs=("may", "june"), epoch=epoch))
    marks = [WaterMark("gauge", (None, None, LEVEL + z), 0.001, name) for name, z in (("june", 3.0), ("may", 0.0))]

    scene = reconstruct_with(survey, levels(survey, *marks))

    found = summarize(scene)
    assert found["water_levels_cm"]["june"]["height"] == pytest.approx(LEVEL + 3.0, abs=3e-3)
    assert found["water_levels_cm"]["may"]["height"] == pytest.approx(LEVEL, abs=3e-3)
    assert [each["source"] for each in found["water_level_from"] if each["weight_percent"] > 90.0] == [
        "gauge of may",
        "gauge of june",
    ]
    assert contradicted(scene) == ()


def test_check_points_are_compared_and_take_no_part(survey_of, draw):
    survey = positioned(survey_of(cameras=6, points=150, noise=0.1, gravity_error_deg=0.3), draw, 0.05)
    pixels, _ = survey.basin.project()
    lift = torch.tensor((0.0, 0.0, LEVEL)).double()
    information = (100.0 * torch.eye(3)).tolist()
    points = {}
    for i in range(4):
        where = {name: pixels[view, i].tolist() for view, name in enumerate(survey.capture.names)}
        off = torch.tensor((2.0, 0.0, 0.0)).double() if i == 3 else 0.0
        points[f"m{i}"] = ControlPoint(
            where, ((survey.basin.points[i] + lift + off).tolist(), information), None, i > 1
        )
    stated = resolve({}, points, [], survey.capture.names)
    assert (stated.known_control.tolist(), stated.check_control.tolist()) == ([0, 1], [2, 3])

    scene = reconstruct_with(survey, stated)

    known = scene.assessment.surveyed
    assert float(known.check_off[0].norm()) < 0.3
    assert float(known.check_off[1, 0]) == pytest.approx(-2.0, abs=0.3)
    assert bool((known.sigma < 0.5).all())
    assert float((scene.views.center - survey.basin.center).norm(dim=-1).max()) < 0.2
    assert contradicted(scene) == ()


def test_water_above_the_cameras_and_epochs_that_nobody_photographed_are_refused(river):
    capture = river.capture
    check_levels(levels(river, WaterMark("gauge", (None, None, LEVEL), 0.01)), capture)

    with pytest.raises(SurveyError, match="gauge of the survey puts the water at 500, above all cameras"):
        check_levels(levels(river, WaterMark("gauge", (None, None, 500.0), 0.01)), capture)
    with pytest.raises(SurveyError, match=r"is of the epoch 'july', but it must be one of .* they have none"):
        check_levels(levels(river, WaterMark("gauge", (None, None, LEVEL), 0.01, "july")), capture)
    with pytest.raises(SurveyError, match=r"is of the epoch '', but it must be one of .*: may, june"):
        check_levels(
            levels(river, WaterMark("gauge", (None, None, LEVEL), 0.01)), replace(capture, epochs=("may", "june"))
        )
