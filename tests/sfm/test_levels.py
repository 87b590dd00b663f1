"""Photographs of two days, between which the water rose."""

from dataclasses import replace

import pytest
import torch

from tests.sfm.test_reconstruct_sparse import reconstruct
from torchrefrac.camera import RefractiveCamera
from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Cameras
from torchrefrac.sfm import levels
from torchrefrac.sfm.levels import smaller_group


@pytest.fixture
def of_two_days(survey_of, draw):
    """`of_two_days(rise, later)`: a survey whose cameras `later` look through water that stands higher by `rise` (cm).
    Cameras stand 30 and 40 cm above that of the first day in turn, the bottom lies 40 to 100 cm below it."""

    def make(rise, later=(), focal=1.0):
        survey = survey_of(cameras=6, points=150, gravity_error_deg=0.5)
        down = torch.zeros_like(survey.basin.center)
        down[list(later), 2] = -rise
        basin, seen, (given,) = survey.basin, survey.seen, [survey.capture.cameras[0]]
        cameras = RefractiveCamera(
            basin.lens, basin.rotation[seen.view], (basin.center + down)[seen.view], FlatInterface(basin.index_ratio)
        )
        pixels, _ = cameras.project(basin.points[seen.point] + down[seen.view])
        pixels = pixels + 0.1 * draw.normal(len(seen), 2)
        capture = replace(survey.capture, cameras=Cameras.of([replace(given, focal=focal * given.focal)]))
        return replace(survey, seen=replace(seen, pixels=pixels), capture=capture)

    return make


@pytest.mark.parametrize(("later", "rise"), [((3, 4, 5), 3.0), ((2, 5), -8.0)])
def test_the_images_of_the_other_day_are_named_with_how_the_water_rose(of_two_days, later, rise):
    survey = of_two_days(rise, later)
    scene = reconstruct(survey)
    found, *others = contradictions(scene, survey.capture)
    higher = scene.assessment.levels
    named = [image in later for image in range(6)]
    assert found.code == "water_level_contradicts"
    assert higher is not None
    assert (higher != 0.0).tolist() in (named, [not each for each in named])
    assert float(higher.abs().max()) == pytest.approx(abs(rise), rel=0.05)
    assert [str(other.code) for other in others] == []
    assert ("higher" if rise > 0.0 else "lower") in found.message or len(later) == 3


def test_views_one_after_the_other_may_have_a_surface_together(of_two_days, monkeypatch):
    monkeypatch.setattr(levels, "MOST_SURFACES", 4)
    survey = of_two_days(3.0, (3, 4, 5))

    found = reconstruct(survey).assessment.levels

    assert found is not None
    assert (found != 0.0).tolist() in ([False] * 3 + [True] * 3, [True] * 3 + [False] * 3)
    assert float(found.abs().max()) == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize("focal", [1.0, 1.05])
def test_water_that_did_not_rise_has_one_level_whatever_the_lens(of_two_days, focal):
    survey = of_two_days(0.0, focal=focal)
    scene = reconstruct(survey)
    assert scene.assessment.levels is None
    codes = [str(found.code) for found in contradictions(scene, survey.capture)]
    assert codes == [] if focal == 1.0 else codes[0] == "intrinsics_contradict"


def test_the_smaller_of_two_groups_is_found():
    values = torch.tensor([0.1, 5.0, 0.0, 5.2, -0.1, 0.2], dtype=torch.float64)
    assert smaller_group(values).tolist() == [False, True, False, True, False, False]
    assert smaller_group(-values).tolist() == [False, True, False, True, False, False]
