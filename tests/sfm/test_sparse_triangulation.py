"""Points from the tracks of registered images."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.sfm import SfmOptions
from torchrefrac.sfm.model import pad_by_track
from torchrefrac.sfm.rays import triangulate_rays
from torchrefrac.sfm.triangulation import triangulate_tracks

OPTIONS = SfmOptions(min_angle_deg=0.5)


@pytest.mark.parametrize("land", [0, 30, 60], ids=["water", "both", "land"])
def test_rays_meet_in_their_points_below_and_above_the_water(survey_of, land):
    survey = survey_of(land=land)
    model = survey.model()
    _, table, present = pad_by_track(model.tracks, torch.arange(len(survey.wrong)))

    points, angle, valid = triangulate_rays(
        model.cameras(model.tracks.image[table]), model.tracks.pixels[table], present
    )

    assert valid.all()
    torch.testing.assert_close(points, survey.basin.points, rtol=0.0, atol=1e-7)
    assert (angle > 0.02).all()


def test_the_angle_of_a_land_point_is_that_between_its_straight_rays(survey_of):
    survey = survey_of(cameras=2, land=60)
    camera = survey.model().cameras(torch.tensor([0, 1]).expand(60, 2))
    pixels = survey.tracks.pixels.reshape(60, 2, 2)

    _, angle, _ = triangulate_rays(camera, pixels, torch.ones(60, 2, dtype=torch.bool))

    to_first, to_second = (survey.basin.points[:, None] - survey.basin.center).unbind(dim=1)
    expected = torch.atan2(torch.linalg.cross(to_first, to_second).norm(dim=-1), (to_first * to_second).sum(dim=-1))
    torch.testing.assert_close(angle, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])
def test_all_tracks_get_their_points_and_all_observations_support_them(survey_of, index_ratio):
    survey = survey_of(land=10, index_ratio=index_ratio)

    model = triangulate_tracks(survey.model(), OPTIONS)

    assert model.has_point.all()
    assert model.active.all()
    torch.testing.assert_close(model.points, survey.basin.points, rtol=0.0, atol=1e-7)


def test_a_wrong_observation_is_set_aside_and_the_others_make_the_point(survey_of):
    survey = survey_of(cameras=6, noise=0.1)
    count = torch.bincount(survey.tracks.track)
    first = torch.searchsorted(survey.tracks.track, (count >= 5).nonzero()[:, 0])
    assert len(first) > 10
    pixels = survey.tracks.pixels.clone()
    pixels[first] += 50.0
    model = survey.model()

    model = triangulate_tracks(replace(model, tracks=replace(model.tracks, pixels=pixels)), OPTIONS)

    assert model.has_point.all()
    assert not model.active[first].any()
    assert model.active.sum() == len(pixels) - len(first)
    assert (model.points - survey.basin.points).norm(dim=-1).median() < 0.2


def test_tracks_of_which_one_registered_image_is_left_get_no_point(survey_of):
    survey = survey_of(cameras=3)
    model = replace(survey.model(), registered=torch.tensor([True, True, False]))

    triangulated = triangulate_tracks(model, OPTIONS)

    seen = torch.bincount(model.tracks.track[model.visible()], minlength=60)
    assert torch.equal(triangulated.has_point, seen >= 2)
    assert torch.equal(triangulated.active, model.visible() & (seen >= 2)[model.tracks.track])


def test_points_that_are_there_stay_as_they_are(survey_of):
    survey = survey_of()
    model = survey.model(with_points=True)
    model = replace(model, points=model.points + 1.0, has_point=torch.arange(60) < 20, active=model.tracks.track < 20)

    triangulated = triangulate_tracks(model, OPTIONS)

    assert torch.equal(triangulated.points[:20], model.points[:20])
    torch.testing.assert_close(triangulated.points[20:], survey.basin.points[20:], rtol=0.0, atol=1e-7)


def test_rays_that_open_too_little_make_no_point(survey_of):
    survey = survey_of(cameras=2)

    model = triangulate_tracks(survey.model(), replace(OPTIONS, min_angle_deg=80.0))

    assert not model.has_point.any()
    assert not model.active.any()


def test_observations_that_agree_on_nothing_make_no_point(survey_of):
    survey = survey_of(cameras=2, outliers=1.0)

    model = triangulate_tracks(survey.model(), OPTIONS)

    assert model.has_point.double().mean() < 0.1


def test_without_registered_images_nothing_happens(survey_of):
    model = replace(survey_of().model(), registered=torch.zeros(4, dtype=torch.bool))

    assert triangulate_tracks(model, OPTIONS) is model
