"""Gravity that was stated wrongly."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.geometry import align_above_plane, rotate, so3_exp
from torchrefrac.recorder import SilentRecorder
from torchrefrac.sfm import RefractiveInitializer, SfmOptions, verify_pairs, with_right_gravity
from torchrefrac.sfm.gravity import contradicted_gravity, suspect_images, unlikely, worst_gravity
from torchrefrac.sfm.vertical import angle_between

FLIPPED = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)


@pytest.fixture
def stated(survey_of):
    """`stated(change)`: a survey of six cameras with gravity to half a degree, as `change` states it."""

    def make(change):
        survey = survey_of(cameras=6, points=300, index_ratio=1.33, noise=0.1, outliers=0.05, gravity_error_deg=0.5)
        down = change(survey.capture.down_in_cam.clone())
        return replace(survey, capture=replace(survey.capture, down_in_cam=down))

    return make


def _turned(degrees, *images):
    def change(down):
        rows = list(images) or slice(None)
        axis = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
        down[rows] = rotate(so3_exp(math.radians(degrees) * axis), down[rows])
        return down

    return change


def _flipped(image):
    def change(down):
        down[image] *= FLIPPED
        return down

    return change


def _checked(survey, generator):
    """The images that are suspected, and the capture with right gravity."""
    features, matches, options = survey.features(), survey.pairs(), SfmOptions()
    initializer = RefractiveInitializer(survey.capture, 1.33, options)
    pairs = verify_pairs(matches, features, initializer, options.min_pair_inliers, generator, SilentRecorder())
    given = survey.capture, matches, pairs, features
    return suspect_images(*given, options), with_right_gravity(*given, 1.33, options, SilentRecorder())


def test_right_gravity_is_left_alone(stated, generator):
    survey = stated(lambda down: down)
    suspects, capture = _checked(survey, generator)
    assert not suspects
    assert capture is survey.capture


def test_an_image_whose_gravity_is_flipped_gets_the_vertical_that_refraction_shows(stated, generator):
    survey = stated(_flipped(2))
    suspects, capture = _checked(survey, generator)
    assert suspects == {2}
    off = angle_between(capture.down_in_cam, survey.basin.down_in_cam)
    assert float(off[2]) < 4.0 * float(capture.down_sigma[2])
    others = [0, 1, 3, 4, 5]
    assert torch.equal(capture.down_in_cam[others], survey.capture.down_in_cam[others])


@pytest.mark.slow
def test_of_a_survey_with_all_axes_mixed_up_all_verticals_are_found(stated, generator):
    survey = stated(lambda down: down * down.new_tensor((1.0, -1.0, 1.0)))
    suspects, capture = _checked(survey, generator)
    assert len(suspects) > 3
    assert (angle_between(capture.down_in_cam, survey.basin.down_in_cam) < 4.0 * capture.down_sigma).all()


def _reconstructed(survey):
    from tests.sfm.test_reconstruct_sparse import reconstruct  # noqa: PLC0415

    scene = reconstruct(survey)
    aligned = align_above_plane(scene.views.center, survey.basin.center).apply(scene.views.center)
    return scene, (aligned - survey.basin.center).norm(dim=-1)


@pytest.mark.parametrize("degrees", [5.0, 15.0])
def test_gravity_that_all_others_contradict_is_not_used(stated, degrees):
    survey = stated(_turned(degrees, 4))
    scene, off = _reconstructed(survey)
    assert scene.views.registered.all()
    assert float(off.max()) < 0.15
    found = contradictions(scene, survey.capture)
    assert [(str(finding.code), finding.images) for finding in found] == [("gravity_contradicts", ("4.jpg",))]
    assert "4.jpg" in found[0].message


def test_where_most_gravity_is_wrong_none_is_used(stated):
    survey = stated(_turned(8.0))
    scene, off = _reconstructed(survey)
    assert float(off.max()) < 0.5
    (found,) = contradictions(scene, survey.capture)
    assert len(found.images) == 6


def test_right_gravity_is_contradicted_once_in_some_hundred_times(draw):
    for count in (1, 5, 50):
        largest = draw.normal(2000, count, 2).norm(dim=-1).amax(dim=-1)
        assert float((largest > unlikely(count)).double().mean()) < 0.006


def test_what_is_pulled_along_is_not_called_wrong(survey_of):
    survey = survey_of(cameras=3)
    scene = survey.scene()
    down = rotate(
        so3_exp(torch.tensor([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.3, 0.0, 0.0]]).double()), survey.basin.down_in_cam
    )
    sigma = torch.full((3,), 0.01, dtype=torch.float64)
    assert contradicted_gravity(scene, down, sigma).tolist() == [False, True, True]
    assert worst_gravity(scene, down, sigma).tolist() == [False, False, True]
    sigma[2] = torch.inf
    assert worst_gravity(scene, down, sigma).tolist() == [False, True, False]
