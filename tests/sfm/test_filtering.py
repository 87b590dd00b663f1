"""Which observations, points and views stay."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.sfm import Filtering, Rules, filter_points
from torchrefrac.sfm.filter_points import affordable_length

RULES = Rules(min_angle_deg=0.5, max_error=2.0, min_support=0)


@pytest.fixture
def scene(survey_of):
    return survey_of().scene(with_points=True)


def shifted(scene, shift):
    """With pixels moved by `shift` (k, 2)."""
    return replace(scene, observations=replace(scene.observations, pixels=scene.observations.pixels + shift))


def nonsense(scene, view, *, spare=0):
    """With all pixels of a view far off but for the first `spare` ones."""
    rows = (scene.observations.view == view).nonzero()[spare:, 0]
    return shifted(scene, torch.zeros_like(scene.observations.pixels).index_fill(0, rows, 30.0))


def test_at_the_truth_all_stays(scene):
    filtered, outcome = filter_points(scene, RULES)

    assert filtered.placed.all()
    assert filtered.accepted.all()
    assert outcome.kind is Filtering.DONE
    assert str(outcome) == "60 points stay"


def test_an_observation_beyond_max_error_is_set_aside(scene):
    point = scene.observations.point
    first, last = (torch.bincount(point)[point] >= 3).nonzero()[[0, -1], 0]
    shift = torch.zeros_like(scene.observations.pixels)
    shift[first, 0] += 2.1
    shift[last, 1] += 1.9

    filtered, _ = filter_points(shifted(scene, shift), RULES)

    assert (~filtered.accepted).nonzero()[:, 0].tolist() == [int(first)]


def test_an_observation_that_was_set_aside_comes_back_when_its_error_is_small(scene):
    accepted = torch.arange(len(scene.accepted)) % 5 != 0

    assert filter_points(replace(scene, accepted=accepted), RULES)[0].accepted.all()


@pytest.mark.parametrize("min_length", [2, 3, 4])
def test_a_point_that_too_few_views_see_goes_with_its_observations(scene, min_length):
    length = torch.bincount(scene.observations.point)
    assert (length >= min_length).any()

    filtered, outcome = filter_points(scene, replace(RULES, min_track_length=min_length))

    assert torch.equal(filtered.placed, length >= min_length)
    assert torch.equal(filtered.accepted, filtered.placed[scene.observations.point])
    assert str(outcome) == f"{int((length >= min_length).sum())} points stay"


def test_each_point_may_need_a_number_of_observations_of_its_own(scene):
    length = torch.bincount(scene.observations.point)
    wanted = length + torch.arange(60) % 2

    filtered, _ = filter_points(scene, replace(RULES, min_track_length=wanted))

    assert torch.equal(filtered.placed, torch.arange(60) % 2 == 0)


def test_a_point_far_from_where_it_is_seen_goes(scene):
    points = scene.points.clone()
    points[7] += 50.0

    filtered, _ = filter_points(replace(scene, points=points), RULES)

    assert (~filtered.placed).nonzero()[:, 0].tolist() == [7]


def test_a_point_behind_the_cameras_goes(scene):
    points = scene.points.clone()
    points[7] = points.new_tensor((0.0, 0.0, 500.0))

    filtered, _ = filter_points(replace(scene, points=points), RULES)

    assert (~filtered.placed).nonzero()[:, 0].tolist() == [7]


def test_a_point_seen_under_too_small_an_angle_goes(scene):
    filtered, _ = filter_points(scene, replace(RULES, min_angle_deg=170.0))

    assert not filtered.placed.any()
    assert not filtered.accepted.any()


def test_a_track_without_a_point_does_not_get_one(scene):
    placed = torch.arange(60) != 7

    filtered, _ = filter_points(replace(scene, placed=placed), RULES)

    assert torch.equal(filtered.placed, placed)


def test_nothing_is_left_of_a_scene_without_points(scene):
    filtered, _ = filter_points(replace(scene, placed=torch.zeros_like(scene.placed)), RULES)

    assert not filtered.placed.any()
    assert not filtered.accepted.any()


@pytest.mark.parametrize(("support", "lost"), [(5, (2,)), (6, ())])
def test_a_view_with_next_to_no_observations_is_lost_and_named(scene, support, lost):
    filtered, outcome = filter_points(nonsense(scene, 2, spare=support), replace(RULES, min_support=6))

    assert outcome.views == lost
    assert outcome.kind is (Filtering.LOST_VIEWS if lost else Filtering.DONE)
    assert outcome.done is not bool(lost)
    assert str(outcome).endswith("but some views are left with next to none") is bool(lost)
    assert filtered.views.registered.tolist() == [True, True, not lost, True]
    assert int(filtered.support()[2]) == (0 if lost else support)


def test_what_a_lost_view_alone_ties_together_is_lost_with_it(scene):
    """Points of which one observation is left go, and so may the next view."""
    seen = scene.observations
    only_two = (seen.view == 3) & (torch.bincount(seen.point[seen.view == 2], minlength=60) == 0)[seen.point]
    shift = torch.where(only_two[:, None], 30.0, torch.zeros_like(seen.pixels))
    given = shifted(nonsense(scene, 2, spare=5), shift)

    filtered, outcome = filter_points(given, replace(RULES, min_support=6))

    assert 2 in outcome.views
    assert int(filtered.support()[filtered.views.registered].min()) >= 6
    length = torch.bincount(seen.point[filtered.accepted], minlength=60)
    assert torch.equal(filtered.placed, length >= 2)
    assert filtered.views.registered[seen.view[filtered.accepted]].all()


def test_a_view_that_was_not_registered_is_not_lost(scene):
    registered = torch.tensor([True, True, False, True])

    filtered, outcome = filter_points(
        replace(scene, views=replace(scene.views, registered=registered)), replace(RULES, min_support=6)
    )

    assert outcome.views == ()
    assert torch.equal(filtered.views.registered, registered)
    assert not (scene.observations.view[filtered.accepted] == 2).any()


def test_the_track_length_that_can_be_asked_for_leaves_every_view_its_support(scene):
    length = torch.bincount(scene.observations.point)
    least = [
        int(torch.bincount(scene.observations.view[(length >= n)[scene.observations.point]]).min()) for n in (3, 4)
    ]

    for inliers, expected in ((least[1], 4), (least[1] + 1, 3), (least[0] + 1, 2)):
        assert affordable_length(scene, replace(RULES, min_registration_inliers=inliers), 9) == expected
    assert affordable_length(scene, replace(RULES, min_registration_inliers=1), 3) == 3
