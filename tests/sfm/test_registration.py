"""One more view."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.geometry import Rigid
from torchrefrac.sfm import (
    Pose,
    PoseInitializer,
    RefractiveInitializer,
    Registration,
    Rules,
    SfmOptions,
    register,
    register_each,
)
from torchrefrac.sfm.pose import OneByOne
from torchrefrac.sfm.register import visible_points

OPTIONS = SfmOptions(min_registration_inliers=20)


@pytest.fixture
def without_last(survey_of):
    """A survey, and its true scene in which the last of four views is not registered yet."""
    survey = survey_of(points=80)
    scene = survey.scene(with_points=True)
    rotation, center = scene.views.rotation.clone(), scene.views.center.clone()
    rotation[3], center[3] = torch.eye(3, dtype=torch.float64), 0.0
    views = replace(scene.views, pose=Rigid(rotation, center), registered=torch.arange(4) < 3)
    return survey, replace(scene, views=views)


@pytest.fixture
def rules(generator):
    """`rules(poses)`: by what views are registered."""
    return lambda poses: OPTIONS.rules(poses, seed=generator)


class Answering(OneByOne, PoseInitializer):
    """An initialiser that gives one answer and keeps what it was asked."""

    def __init__(self, inliers):
        self.inliers, self.asked = inliers, None

    def absolute(self, image, generator):
        number, _, pixels, points = image
        self.asked = number, pixels, points
        if self.inliers is None:
            return None
        return Pose(
            torch.eye(3, dtype=torch.float64),
            torch.ones(3, dtype=torch.float64),
            torch.arange(len(pixels)) < self.inliers,
        )


def test_a_view_is_registered_where_it_stood(without_last, rules):
    survey, scene = without_last

    grown, outcome = register(scene, 3, rules(RefractiveInitializer(survey.capture, survey.basin.index_ratio, OPTIONS)))

    assert outcome.kind is Registration.DONE
    assert grown.views.registered.all()
    torch.testing.assert_close(grown.views.center[3], survey.basin.center[3], rtol=0.0, atol=1e-3)
    torch.testing.assert_close(grown.views.rotation[3], survey.basin.rotation[3], rtol=0.0, atol=1e-5)


def test_the_other_views_stay_as_they_are(without_last, rules):
    _, scene = without_last

    grown, _ = register(scene, 3, rules(Answering(30)))

    assert torch.equal(grown.views.center[:3], scene.views.center[:3])
    assert torch.equal(grown.views.rotation[:3], scene.views.rotation[:3])
    assert not scene.views.registered[3]


def test_the_initialiser_is_asked_about_the_points_that_exist(without_last, rules):
    _, scene = without_last
    placed, seen = torch.arange(80) % 3 != 0, scene.observations
    initializer = Answering(None)

    register(replace(scene, placed=placed), 3, rules(initializer))

    rows = (seen.view == 3) & placed[seen.point]
    assert initializer.asked[0] == 3
    assert torch.equal(initializer.asked[1], seen.pixels[rows])
    assert torch.equal(initializer.asked[2], scene.points[seen.point[rows]])


def test_a_view_that_sees_too_few_points_is_refused_with_the_numbers(without_last, rules):
    _, scene = without_last
    placed = torch.zeros(80, dtype=torch.bool)
    placed[scene.observations.point[scene.observations.view == 3][:19]] = True

    same, outcome = register(replace(scene, placed=placed), 3, rules(Answering(19)))

    assert outcome.kind is Registration.FEW_POINTS
    assert str(outcome) == "sees only 19 reconstructed points, of which a pose needs 20"
    assert not same.views.registered[3]


@pytest.mark.parametrize(("inliers", "agreeing"), [(None, 0), (19, 19)])
def test_a_pose_that_too_few_points_agree_with_is_refused_with_the_numbers(without_last, rules, inliers, agreeing):
    _, scene = without_last
    count = int((scene.observations.view == 3).sum())

    same, outcome = register(scene, 3, rules(Answering(inliers)))

    expected = f"no pose agrees with more than {agreeing} of the {count} reconstructed points that it sees"
    assert outcome.kind is Registration.NO_POSE
    assert str(outcome) == expected
    assert same is scene


def test_rules_that_find_no_poses_register_nothing(without_last):
    with pytest.raises(ValueError, match="poses is None, but must find poses"):
        register(without_last[1], 3, Rules())


def test_visible_points_are_counted_for_every_view(without_last):
    _, scene = without_last
    placed, seen = torch.arange(80) % 3 == 0, scene.observations

    counts = visible_points(replace(scene, placed=placed))

    assert counts.tolist() == [int(((seen.view == i) & placed[seen.point]).sum()) for i in range(4)]


def test_the_observations_that_agree_with_the_pose_support_the_view_from_then_on(without_last, rules):
    _, scene = without_last
    scene = replace(scene, accepted=scene.accepted & (scene.observations.view != 3))

    grown, outcome = register(scene, 3, rules(Answering(25)))

    new = grown.accepted & ~scene.accepted
    assert int(new.sum()) == outcome.numbers["agreeing"] == 25
    assert (grown.observations.view[new] == 3).all()
    assert str(outcome).startswith("25 of the ")


def test_views_of_a_round_are_registered_as_each_is_alone_in_any_order(without_last, rules, draw):
    survey, scene = without_last
    seen, registered = scene.observations, torch.arange(4) < 1
    lost, alone = seen.view == 2, seen.view == 1
    pixels = torch.where(lost[:, None], 700.0 * draw.uniform(0.0, 1.0, len(seen), 2), seen.pixels)
    seen = replace(seen, pixels=pixels)[~alone | (seen.point < 10)]
    accepted = registered[seen.view]
    scene = replace(scene, observations=seen, accepted=accepted, views=replace(scene.views, registered=registered))
    by = rules(RefractiveInitializer(survey.capture, survey.basin.index_ratio, OPTIONS))

    together, outcomes = register_each(scene, [1, 2, 3], by)
    backwards, reversed_outcomes = register_each(scene, [3, 2, 1], by)
    single, outcome = register(scene, 3, by)

    kinds = [Registration.FEW_POINTS, Registration.NO_POSE, Registration.DONE]
    assert [one.kind for one in outcomes] == kinds
    assert [str(one) for one in outcomes] == [str(one) for one in reversed_outcomes[::-1]]
    assert str(outcomes[2]) == str(outcome)
    for other in (backwards, single):
        assert torch.equal(together.views.registered, other.views.registered)
        assert torch.equal(together.accepted, other.accepted)
        torch.testing.assert_close(together.views.center, other.views.center, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(together.views.rotation, other.views.rotation, rtol=1e-12, atol=1e-12)


def test_no_views_are_registered_where_none_are_asked_for(without_last, rules):
    survey, scene = without_last

    same, outcomes = register_each(
        scene, [], rules(RefractiveInitializer(survey.capture, survey.basin.index_ratio, OPTIONS))
    )

    assert same is scene
    assert outcomes == []
