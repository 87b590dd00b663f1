"""Warnings about a finished scene, from what went in."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.scene import Assessment, Cameras, WaterExtent


@pytest.fixture
def survey(survey_of):
    return survey_of(cameras=6, points=120, index_ratio=1.33, noise=0.1)


def _codes(scene, capture):
    return [str(finding.code) for finding in contradictions(scene, capture)]


def _all_measured(capture, heights):
    return replace(capture, height=heights, has_height=torch.ones_like(capture.has_height))


def test_a_scene_that_is_as_stated_has_no_warnings(survey):
    scene = survey.scene(with_points=True)
    assert _codes(scene, _all_measured(survey.capture, survey.capture.height)) == []


def test_a_height_that_does_not_fit_is_named(survey):
    heights = survey.capture.height.clone()
    heights[1] *= 10.0
    (found,) = contradictions(survey.scene(with_points=True), _all_measured(survey.capture, heights))
    assert (found.code, found.images) == ("height_contradicts", ("1.jpg",))
    assert f"{float(heights[1]):.4g} cm stated" in found.message


def test_heights_from_another_level_are_recognised(survey):
    heights = survey.capture.height + 40.0
    (found,) = contradictions(survey.scene(with_points=True), _all_measured(survey.capture, heights))
    assert (found.code, found.images) == ("height_contradicts", ())
    assert "all heights are too large by 40 cm" in found.message


def test_a_view_with_few_large_errors_is_named(survey):
    scene = survey.scene(with_points=True)
    of_last = scene.observations.view == 5
    pixels = torch.where(of_last[:, None], scene.observations.pixels + 3.0, scene.observations.pixels)
    few = ~of_last | (scene.observations.point < 30)
    scene = replace(scene, observations=replace(scene.observations, pixels=pixels), accepted=few)
    (found,) = contradictions(scene, survey.capture)
    assert (found.code, found.images) == ("weak_image", ("5.jpg",))


def test_a_camera_none_of_whose_photographs_is_placed_is_named(survey):
    scene = survey.scene(with_points=True)
    cameras = Cameras.of([scene.cameras[0]] * 2, ("phone", "gopro"))
    camera, lost = torch.arange(6) // 4, torch.arange(6) >= 4
    views = replace(scene.views, camera=camera)
    assert _codes(replace(scene, cameras=cameras, views=views), survey.capture) == []

    views = replace(views, registered=views.registered & ~lost)
    rows = ~lost[scene.observations.view]
    scene = replace(scene, cameras=cameras, views=views, failures={"4.jpg": "sees nothing"}, accepted=rows)
    (found,) = contradictions(scene, survey.capture)

    assert (found.code, found.images) == ("camera_not_placed", ("4.jpg", "5.jpg"))
    assert "none of the photographs of gopro could be placed (4.jpg, 5.jpg: sees nothing)" in found.message


def test_copies_of_a_photograph_are_told(survey, tmp_path):
    paths = tuple(tmp_path / name for name in survey.capture.names)
    for path, content in zip(paths, ("a", "b", "a", "cc", "d", "a"), strict=True):
        path.write_text(content)
    (found,) = contradictions(survey.scene(with_points=True), replace(survey.capture, paths=paths))
    assert (found.code, found.images) == ("duplicate_image", ("0.jpg", "2.jpg", "5.jpg"))


def test_photographs_that_could_not_be_read_are_told(survey):
    capture = replace(survey.capture, damaged={"9.jpg": "9.jpg is damaged: it ends before its image does"})
    (found,) = contradictions(survey.scene(with_points=True), capture)
    assert (found.code, found.images) == ("damaged_image", ("9.jpg",))
    assert "it ends before its image does" in found.message


@pytest.mark.parametrize(("sigma_deg", "codes"), [(0.8, []), (2.5, ["gravity_undetermined"])])
def test_gravity_that_nobody_stated_and_images_show_badly_is_told(survey, sigma_deg, codes):
    found = torch.full_like(survey.capture.height, sigma_deg).deg2rad()
    scene = replace(survey.scene(with_points=True), capture=replace(survey.capture, down_sigma=found))
    assert _codes(scene, replace(survey.capture, has_gravity=False)) == codes


def test_water_that_was_put_where_it_does_nothing_was_not_seen(survey):
    scene = survey.scene(with_points=True)
    points = scene.points * scene.points.new_tensor((1.0, 1.0, -1.0))
    scene = replace(scene, points=points, assessment=Assessment(wished={"index_ratio": (0.1, 0.2)}))
    (found, *_) = contradictions(scene, survey.capture)
    assert found.code == "no_refraction_seen"
    assert "100 % of the points above the water" in found.message


@pytest.mark.parametrize(
    ("wished", "codes"),
    [
        ({"index_ratio": (-0.04, 0.002), "focal": (0.001, 0.001)}, ["index_contradicts"]),
        ({"index_ratio": (-0.4, 0.01)}, ["no_refraction_seen"]),
        ({"focal": (0.3, 0.01)}, ["intrinsics_contradict"]),
        ({"index_ratio": (0.04, 0.02), "focal": (0.01, 0.001)}, []),
    ],
)
def test_what_the_images_wish_of_water_and_lens(survey, wished, codes):
    scene = replace(survey.scene(with_points=True), assessment=Assessment(wished=wished))
    assert _codes(scene, survey.capture) == codes


def _with_dry(scene, count):
    return replace(scene, dry=torch.arange(len(scene.points)) < count)


def test_points_outside_the_water_are_counted_where_nobody_says_where_it_ends(survey):
    scene = _with_dry(survey.scene(with_points=True), 36)
    (found,) = contradictions(scene, survey.capture)
    assert (found.code, found.images) == ("points_outside_water", ())
    assert found.message.startswith("36 points, 30 % of all, lie below the water's level")
    assert "water_extent" in found.message


def test_where_the_extent_is_stated_points_outside_the_water_are_no_surprise(survey):
    stated = replace(survey.capture, water_extent=WaterExtent(torch.zeros(3, 2, dtype=torch.float64)))
    assert _codes(_with_dry(survey.scene(with_points=True), 36), stated) == []


@pytest.mark.parametrize(
    ("disputed", "words"),
    [
        ((60, 3), "60 points within it are seen straight; "),
        ((3, 60), "60 points beyond it are seen through water; "),
        ((30, 60), "30 points within it are seen straight and 60 points beyond it are seen through water; "),
    ],
)
def test_an_extent_that_the_images_contradict_is_named(survey, disputed, words):
    stated = replace(survey.capture, water_extent=WaterExtent(torch.zeros(3, 2, dtype=torch.float64)))
    scene = replace(survey.scene(with_points=True), assessment=Assessment(disputed=disputed))
    (found,) = contradictions(scene, stated)
    assert found.code == "points_outside_water"
    assert words in found.message


def test_no_focal_length_is_named_where_the_images_do_not_show_one(survey):
    assessment = Assessment(wished={"focal": (-10.6, 0.6)})
    (found,) = contradictions(replace(survey.scene(with_points=True), assessment=assessment), survey.capture)
    assert found.code == "intrinsics_contradict"
    assert "that are far shorter, but 667 px are stated, 75 degrees" in found.message


def test_a_wish_for_another_focal_length_that_is_no_more_than_vague_hides_nothing_else(survey):
    scene = replace(survey.scene(with_points=True), assessment=Assessment(wished={"focal": (0.6, 0.3)}))
    down = survey.capture.down_in_cam.clone()
    down[1] = down[1].roll(1)

    assert _codes(scene, replace(survey.capture, down_in_cam=down)) == ["gravity_contradicts"]


def test_errors_that_observations_have_in_common_excuse_gravity(survey):
    scene = survey.scene(with_points=True)
    turned = replace(survey.capture, down_in_cam=survey.capture.down_in_cam.roll(1, dims=1))
    wide = torch.full((scene.views.num_registered,), 2.0, dtype=torch.float64)

    assert "gravity_contradicts" in _codes(scene, turned)
    assert _codes(replace(scene, assessment=Assessment(common_tilt=wide)), turned) == []


def _through(scene, kind):
    """The same scene with its surface called otherwise: nothing that is compared changes by that."""
    return replace(scene, interfaces=replace(scene.interfaces, kinds=(kind,)))


@pytest.mark.parametrize(
    ("kind", "check"),
    [
        ("surface", "check intrinsics and gravity"),
        ("wall", "check the glass (thickness and index), the distances from it, and intrinsics"),
        ("port", "check the port (distance, tilt and glass) and intrinsics"),
    ],
)
def test_a_wrong_index_ratio_is_looked_for_where_it_can_come_from(survey, kind, check):
    scene = _through(survey.scene(with_points=True), kind)
    wishing = replace(scene, assessment=Assessment(wished={"index_ratio": (0.05, 0.001)}))

    (found,) = (found for found in contradictions(wishing, survey.capture) if found.code == "index_contradicts")

    assert found.message.endswith(check)
    assert ("gravity" in found.message) == (kind == "surface")


def test_points_anywhere_are_in_the_water_of_a_port(survey):
    """Which has no level that they could be above."""
    scene = _through(survey.scene(with_points=True), "port")
    above = replace(scene, points=scene.points + torch.tensor((0.0, 0.0, 500.0), dtype=torch.float64))
    vague = replace(above, assessment=Assessment(wished={"index_ratio": (0.0, 1.0)}))

    assert "no_refraction_seen" not in _codes(vague, survey.capture)


def test_before_a_wall_distances_are_named_and_the_glass(survey):
    scene = _through(survey.scene(with_points=True), "wall")
    heights = survey.capture.height.clone()
    heights[1] *= 10.0
    (odd,) = contradictions(scene, _all_measured(survey.capture, heights))
    (shifted,) = contradictions(scene, _all_measured(survey.capture, survey.capture.height + 40.0))
    assert odd.message.startswith("the distance from the glass of 1.jpg does not fit")
    assert "all distances from the glass are too large by 40 cm, as if they were not counted from the glass" in (
        shifted.message
    )
    levels = torch.tensor((0.0, 0.0, 0.0, 0.0, 2.0, 2.0), dtype=torch.float64)
    (moved,) = contradictions(replace(scene, assessment=Assessment(levels=levels)), survey.capture)
    assert "the glass stood 2 cm nearer when 4.jpg, 5.jpg were taken" in moved.message
