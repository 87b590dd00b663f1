"""Which observations and points stay."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.sfm import SfmOptions
from torchrefrac.sfm.filtering import filter_points

OPTIONS = SfmOptions(min_angle_deg=0.5, max_error=2.0)


@pytest.fixture
def model(survey_of):
    return survey_of().model(with_points=True)


def test_at_the_truth_all_stays(model):
    kept = filter_points(model, OPTIONS)

    assert kept.has_point.all()
    assert kept.active.all()


def test_an_observation_beyond_max_error_is_set_aside(model):
    long_enough = torch.bincount(model.tracks.track)[model.tracks.track] >= 3
    first, last = long_enough.nonzero()[[0, -1], 0]
    pixels = model.tracks.pixels.clone()
    pixels[first, 0] += 2.1
    pixels[last, 1] += 1.9

    kept = filter_points(replace(model, tracks=replace(model.tracks, pixels=pixels)), OPTIONS)

    assert (~kept.active).nonzero()[:, 0].tolist() == [int(first)]


def test_an_observation_that_was_set_aside_comes_back_when_its_error_is_small(model):
    active = torch.arange(len(model.active)) % 5 != 0

    assert filter_points(replace(model, active=active), OPTIONS).active.all()


@pytest.mark.parametrize("min_length", [2, 3, 4])
def test_a_point_that_too_few_images_see_goes_with_its_observations(model, min_length):
    length = torch.bincount(model.tracks.track)
    assert (length >= min_length).any()

    kept = filter_points(model, OPTIONS, min_length)

    assert torch.equal(kept.has_point, length >= min_length)
    assert torch.equal(kept.active, kept.has_point[model.tracks.track])


def test_a_point_far_from_where_it_is_seen_goes(model):
    points = model.points.clone()
    points[7] += 50.0

    kept = filter_points(replace(model, points=points), OPTIONS)

    assert (~kept.has_point).nonzero()[:, 0].tolist() == [7]


def test_a_point_behind_the_cameras_goes(model):
    points = model.points.clone()
    points[7] = points.new_tensor((0.0, 0.0, 500.0))

    kept = filter_points(replace(model, points=points), OPTIONS)

    assert (~kept.has_point).nonzero()[:, 0].tolist() == [7]


def test_a_point_seen_under_too_small_an_angle_goes(model):
    kept = filter_points(model, replace(OPTIONS, min_angle_deg=170.0))

    assert not kept.has_point.any()
    assert not kept.active.any()


def test_a_track_without_a_point_does_not_get_one(model):
    has_point = torch.arange(60) != 7

    kept = filter_points(replace(model, has_point=has_point), OPTIONS)

    assert torch.equal(kept.has_point, has_point)


def test_nothing_is_left_of_a_model_without_points(model):
    kept = filter_points(replace(model, has_point=torch.zeros_like(model.has_point)), OPTIONS)

    assert not kept.has_point.any()
    assert not kept.active.any()
