"""Points from the tracks of registered views."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.geometry import Similarity, so3_exp
from torchrefrac.scene import Interfaces, Observations
from torchrefrac.sfm import Rules, Triangulation, triangulate
from torchrefrac.sfm.frame import transformed
from torchrefrac.sfm.rays import Rays, Tracks

RULES = Rules(min_angle_deg=0.5)


def everything(scene):
    return Tracks.of(scene, torch.arange(len(scene.observations)))


def unregistered(scene, *views):
    registered = torch.ones_like(scene.views.registered)
    registered[list(views)] = False
    return replace(scene, views=replace(scene.views, registered=registered))


def visible(scene):
    """Observations (k) in registered views."""
    return scene.views.registered[scene.observations.view]


def test_tracks_number_the_points_of_their_observations(survey_of):
    survey = survey_of()
    point = torch.tensor([0, 0, 2, 2, 2, 5])
    seen = Observations(torch.arange(6) % 4, point, survey.seen.pixels[:6])
    scene = replace(survey.scene(), observations=seen, accepted=torch.zeros(6, dtype=torch.bool))

    tracks = Tracks.of(scene, torch.tensor([0, 2, 3, 4, 5]))

    assert tracks.ids.tolist() == [0, 2, 5]
    assert tracks.slot.tolist() == [0, 1, 1, 1, 2]
    assert torch.equal(tracks.pixels, seen.pixels[[0, 2, 3, 4, 5]])


def test_observations_are_laid_out_as_one_table_for_each_length_of_a_track(survey_of):
    survey = survey_of()
    point = torch.tensor([0, 0, 2, 2, 2, 5, 7, 7])
    seen = Observations(torch.arange(8) % 4, point, survey.seen.pixels[:8])
    scene = replace(survey.scene(), observations=seen, accepted=torch.zeros(8, dtype=torch.bool))

    tables = list(Tracks.of(scene, torch.tensor([0, 1, 2, 3, 4, 5, 6, 7]))._by_length())

    assert [lines.tolist() for lines, _ in tables] == [[2], [0, 3], [1]]
    assert [table.tolist() for _, table in tables] == [[[5]], [[0, 1], [6, 7]], [[2, 3, 4]]]


def test_no_observations_make_no_tracks(survey_of):
    tracks = Tracks.of(survey_of().scene(), torch.zeros(0, dtype=torch.long))

    assert len(tracks.ids) == len(tracks.slot) == len(tracks.opening()) == 0
    assert [len(part) for part in tracks.meet()] == [0, 0, 0]


@pytest.mark.parametrize("land", [0, 30, 60], ids=["water", "both", "land"])
def test_rays_meet_in_their_points_below_and_above_the_water(survey_of, land):
    survey = survey_of(land=land)

    points, angle, valid = everything(survey.scene()).meet()

    assert valid.all()
    torch.testing.assert_close(points, survey.basin.points, rtol=0.0, atol=1e-7)
    assert (angle > 0.02).all()


@pytest.mark.parametrize("land", [0, 30, 60], ids=["water", "both", "land"])
def test_rays_meet_in_their_points_where_the_water_lies_in_another_frame(survey_of, draw, land):
    """The surface is a plane of any direction then, and land is what lies above it."""
    survey = survey_of(land=land)
    change = Similarity(draw.uniform(0.5, 2.0), so3_exp(draw.normal(3)), 10.0 * draw.normal(3))
    normal = change.rotation[:, 2][None]
    moved = transformed(survey.scene(with_points=True), change)
    scene = replace(moved, interfaces=Interfaces(normal, normal @ change.translation, moved.interfaces.index_ratio))

    points, angle, valid = everything(scene).meet()

    assert valid.all()
    torch.testing.assert_close(points, scene.points, rtol=0.0, atol=1e-6)
    plain = everything(survey.scene(with_points=True))
    torch.testing.assert_close(angle, plain.meet()[1], rtol=0.0, atol=1e-9)
    torch.testing.assert_close(everything(scene).opening(), plain.opening(), rtol=0.0, atol=1e-9)


def test_the_angle_of_a_land_point_is_that_between_its_straight_rays(survey_of):
    survey = survey_of(cameras=2, land=60)
    camera = survey.scene().camera_of(torch.tensor([0, 1]).expand(60, 2))

    _, angle, _ = Rays.of(camera, survey.seen.pixels.reshape(60, 2, 2)).meet(lambda points: points[..., 2])

    to_first, to_second = (survey.basin.points[:, None] - survey.basin.center).unbind(dim=1)
    expected = torch.atan2(torch.linalg.cross(to_first, to_second).norm(dim=-1), (to_first * to_second).sum(dim=-1))
    torch.testing.assert_close(angle, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("land", [0, 30, 60], ids=["water", "both", "land"])
def test_rays_open_in_their_points_as_where_they_meet(survey_of, land):
    tracks = everything(survey_of(land=land).scene(with_points=True))

    torch.testing.assert_close(tracks.opening(), tracks.meet()[1], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])
def test_all_tracks_get_their_points_and_all_observations_support_them(survey_of, index_ratio):
    survey = survey_of(land=10, index_ratio=index_ratio)

    scene, outcome = triangulate(survey.scene(), RULES)

    assert scene.placed.all()
    assert scene.accepted.all()
    torch.testing.assert_close(scene.points, survey.basin.points, rtol=0.0, atol=1e-7)
    assert outcome.kind is Triangulation.DONE
    assert str(outcome) == "60 points are placed"


@pytest.mark.parametrize("rough", [False, True], ids=["fine", "rough"])
def test_a_wrong_observation_is_set_aside_and_the_others_make_the_point(survey_of, rough):
    survey = survey_of(cameras=6, noise=0.1)
    count = torch.bincount(survey.seen.point)
    first = torch.searchsorted(survey.seen.point, (count >= 5).nonzero()[:, 0])
    assert len(first) > 10
    pixels = survey.seen.pixels.clone()
    pixels[first] += 50.0

    scene, _ = triangulate(
        replace(survey, seen=replace(survey.seen, pixels=pixels)).scene(), replace(RULES, rough=rough)
    )

    assert scene.placed.all()
    assert not scene.accepted[first].any()
    assert scene.accepted.sum() == len(pixels) - len(first)
    assert (scene.points - survey.basin.points).norm(dim=-1).median() < 0.2


def test_tracks_of_which_one_registered_view_is_left_get_no_point(survey_of):
    survey = survey_of(cameras=3)
    scene = unregistered(survey.scene(), 2)

    triangulated, _ = triangulate(scene, RULES)

    seen = torch.bincount(survey.seen.point[visible(scene)], minlength=60)
    assert torch.equal(triangulated.placed, seen >= 2)
    assert torch.equal(triangulated.accepted, visible(scene) & (seen >= 2)[survey.seen.point])


def test_points_that_are_there_stay_as_they_are(survey_of):
    survey = survey_of()
    scene = survey.scene(with_points=True)
    there = torch.arange(60) < 20
    scene = replace(scene, points=scene.points + 1.0, placed=there, accepted=there[survey.seen.point])

    triangulated, _ = triangulate(scene, RULES)

    assert torch.equal(triangulated.points[:20], scene.points[:20])
    torch.testing.assert_close(triangulated.points[20:], survey.basin.points[20:], rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("rough", [False, True], ids=["fine", "rough"])
def test_points_that_are_wanted_are_placed_again_and_judged_by_what_they_are_now(survey_of, rough):
    survey = survey_of(cameras=6)
    first = torch.searchsorted(survey.seen.point, (torch.bincount(survey.seen.point) >= 5).nonzero()[:, 0])
    pixels = survey.seen.pixels.clone()
    pixels[first] += 50.0
    scene = replace(survey, seen=replace(survey.seen, pixels=pixels)).scene(with_points=True)
    scene = replace(scene, points=scene.points + 1.0)
    wanted = torch.arange(60) % 2 == 0

    triangulated, outcome = triangulate(scene, replace(RULES, rough=rough), wanted)

    assert torch.equal(triangulated.points[~wanted], scene.points[~wanted])
    torch.testing.assert_close(triangulated.points[wanted], survey.basin.points[wanted], rtol=0.0, atol=1e-4)
    wrong = torch.zeros_like(survey.wrong).index_fill(0, first, True)
    assert torch.equal(triangulated.accepted, ~(wrong & wanted[survey.seen.point]))
    assert str(outcome) == "30 points are placed"


def test_points_that_are_wanted_and_cannot_be_placed_have_no_position_any_more(survey_of):
    scene = unregistered(survey_of(cameras=3).scene(with_points=True), 1, 2)
    wanted = torch.arange(60) < 20

    triangulated, outcome = triangulate(scene, RULES, wanted)

    assert torch.equal(triangulated.placed, ~wanted)
    assert torch.equal(triangulated.accepted, ~wanted[scene.observations.point])
    assert outcome.kind is Triangulation.NOTHING


def test_an_infinite_max_error_judges_nothing(survey_of):
    survey = survey_of(noise=20.0)

    judged, _ = triangulate(survey.scene(), replace(RULES, rough=True))
    scene, _ = triangulate(survey.scene(), replace(RULES, rough=True, max_error=torch.inf))

    assert judged.placed.sum() < 30
    assert scene.placed.sum() > 55
    assert torch.equal(scene.accepted, scene.placed[survey.seen.point])


def test_rays_that_open_too_little_make_no_point(survey_of):
    scene, _ = triangulate(survey_of(cameras=2).scene(), replace(RULES, min_angle_deg=80.0))

    assert not scene.placed.any()
    assert not scene.accepted.any()


def test_observations_that_agree_on_nothing_make_no_point(survey_of):
    scene, _ = triangulate(survey_of(cameras=2, outliers=1.0).scene(), RULES)

    assert scene.placed.double().mean() < 0.1


def test_without_registered_views_nothing_happens(survey_of):
    scene = unregistered(survey_of().scene(), 0, 1, 2, 3)

    triangulated, outcome = triangulate(scene, RULES)

    for name in ("points", "placed", "accepted"):
        assert torch.equal(getattr(triangulated, name), getattr(scene, name))
    assert triangulated.views is scene.views
    assert str(outcome) == "no point is seen by two registered views"
    assert not outcome.done
