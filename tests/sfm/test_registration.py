"""One more image."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.sfm import Pose, RefractiveInitializer, SfmOptions
from torchrefrac.sfm.registration import register_image, visible_points

OPTIONS = SfmOptions(min_registration_inliers=20)


@pytest.fixture
def without_last(survey_of):
    """A survey, and its true model in which the last of four images is not registered yet."""
    survey = survey_of(points=80)
    model = survey.model(with_points=True)
    rotation, center = model.rotation.clone(), model.center.clone()
    rotation[3], center[3] = torch.eye(3, dtype=torch.float64), 0.0
    return survey, replace(model, registered=torch.arange(4) < 3, rotation=rotation, center=center)


class Answering:
    """An initialiser that gives one answer and keeps what it was asked."""

    def __init__(self, inliers):
        self.inliers, self.asked = inliers, None

    def absolute(self, image, pixels, points, generator):
        self.asked = image, pixels, points
        if self.inliers is None:
            return None
        return Pose(
            torch.eye(3, dtype=torch.float64),
            torch.ones(3, dtype=torch.float64),
            torch.arange(len(pixels)) < self.inliers,
        )


def test_an_image_is_registered_where_it_stood(without_last, generator):
    survey, model = without_last
    initializer = RefractiveInitializer(survey.capture, survey.index_ratio, OPTIONS)

    grown, reason = register_image(model, 3, initializer, OPTIONS, generator)

    assert reason == ""
    assert grown.registered.all()
    torch.testing.assert_close(grown.center[3], survey.basin.center[3], rtol=0.0, atol=1e-3)
    torch.testing.assert_close(grown.rotation[3], survey.basin.rotation[3], rtol=0.0, atol=1e-5)


def test_the_other_images_stay_as_they_are(without_last, generator):
    _, model = without_last

    grown, _ = register_image(model, 3, Answering(30), OPTIONS, generator)

    assert torch.equal(grown.center[:3], model.center[:3])
    assert torch.equal(grown.rotation[:3], model.rotation[:3])
    assert not model.registered[3]


def test_the_initialiser_is_asked_about_the_points_that_exist(without_last, generator):
    _, model = without_last
    has_point = torch.arange(80) % 3 != 0
    initializer = Answering(None)

    register_image(replace(model, has_point=has_point), 3, initializer, OPTIONS, generator)

    rows = (model.tracks.image == 3) & has_point[model.tracks.track]
    assert initializer.asked[0] == 3
    assert torch.equal(initializer.asked[1], model.tracks.pixels[rows])
    assert torch.equal(initializer.asked[2], model.points[model.tracks.track[rows]])


def test_an_image_that_sees_too_few_points_is_refused_with_the_numbers(without_last, generator):
    _, model = without_last
    seen = model.tracks.track[model.tracks.image == 3][:19]
    has_point = torch.zeros(80, dtype=torch.bool)
    has_point[seen] = True

    same, reason = register_image(replace(model, has_point=has_point), 3, Answering(19), OPTIONS, generator)

    assert reason == "sees only 19 reconstructed points, of which a pose needs 20"
    assert not same.registered[3]


@pytest.mark.parametrize(("inliers", "agreeing"), [(None, 0), (19, 19)])
def test_a_pose_that_too_few_points_agree_with_is_refused_with_the_numbers(without_last, generator, inliers, agreeing):
    _, model = without_last
    count = int((model.tracks.image == 3).sum())

    same, reason = register_image(model, 3, Answering(inliers), OPTIONS, generator)

    assert reason == f"no pose agrees with more than {agreeing} of the {count} reconstructed points that it sees"
    assert same is model


def test_visible_points_are_counted_for_every_image(without_last):
    _, model = without_last
    has_point = torch.arange(80) % 3 == 0

    counts = visible_points(replace(model, has_point=has_point))

    expected = [int(((model.tracks.image == i) & has_point[model.tracks.track]).sum()) for i in range(4)]
    assert counts.tolist() == expected


def test_the_observations_that_agree_with_the_pose_support_the_image_from_then_on(without_last, generator):
    _, model = without_last
    model = replace(model, active=model.active & (model.tracks.image != 3))

    grown, _ = register_image(model, 3, Answering(25), OPTIONS, generator)

    new = grown.active & ~model.active
    assert int(new.sum()) == 25
    assert (grown.tracks.image[new] == 3).all()
