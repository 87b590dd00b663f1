"""Where the finished scene stands."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.geometry import (
    Similarity,
    align_above_plane,
    align_similarity,
    heading_rotation,
    so3_exp,
    split_heading,
)
from torchrefrac.sfm.frame import fix_frame, transformed

in_water_and_air = pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])


@pytest.fixture
def scene_of(draw):
    """`scene_of(survey)`: the true scene, moved and scaled as far as the images of that index ratio allow."""

    def make(survey):
        scene = survey.scene(with_points=True)
        refractive = survey.basin.index_ratio > 1.0
        turn = heading_rotation(draw.uniform(-3.0, 3.0)) if refractive else so3_exp(draw.normal(3))
        shift = 30.0 * draw.normal(3) * draw.normal(3).new_tensor((1.0, 1.0, 0.0 if refractive else 1.0))
        return transformed(scene, Similarity(draw.uniform(0.2, 5.0), turn, shift))

    return make


def registered(scene, *which):
    return replace(scene, views=replace(scene.views, registered=torch.tensor(which)))


@in_water_and_air
def test_reprojection_errors_stay_as_they_are(survey_of, scene_of, index_ratio):
    survey = survey_of(noise=1.0, index_ratio=index_ratio)
    scene = scene_of(survey)

    fixed = fix_frame(scene, survey.capture)

    torch.testing.assert_close(fixed.errors(), scene.errors(), rtol=0.0, atol=1e-8)


@in_water_and_air
def test_the_scene_keeps_its_shape(survey_of, scene_of, index_ratio):
    survey = survey_of(index_ratio=index_ratio)

    fixed = fix_frame(scene_of(survey), survey.capture)

    align = align_above_plane if index_ratio > 1.0 else align_similarity
    change = align(fixed.views.center, survey.basin.center)
    torch.testing.assert_close(change.apply(fixed.points), survey.basin.points, rtol=0.0, atol=1e-8)


@in_water_and_air
def test_the_first_registered_camera_stands_over_the_origin_with_heading_zero(survey_of, scene_of, index_ratio):
    survey = survey_of(index_ratio=index_ratio)

    fixed = fix_frame(registered(scene_of(survey), False, True, True, True), survey.capture)

    torch.testing.assert_close(fixed.views.center[1, :2], torch.zeros(2, dtype=torch.float64), rtol=0.0, atol=1e-10)
    _, heading = split_heading(fixed.views.rotation[1])
    assert abs(float(heading)) < 1e-10


def test_through_water_a_measured_height_of_any_camera_sets_the_scale(survey_of, scene_of):
    survey = survey_of()
    capture = replace(survey.capture, has_height=torch.tensor([False, False, True, False]))

    fixed = fix_frame(scene_of(survey), capture)

    torch.testing.assert_close(fixed.views.center[:, 2], survey.basin.center[:, 2], rtol=1e-10, atol=0.0)


def test_through_water_several_measured_heights_are_met_by_least_squares(survey_of, scene_of, draw):
    survey = survey_of()
    measured = survey.capture.height * (1.0 + 0.01 * draw.normal(4))  # their sigma
    capture = replace(survey.capture, height=measured, has_height=torch.tensor([True, True, False, True]))

    fixed = fix_frame(scene_of(survey), capture)

    found, wanted = fixed.views.center[capture.has_height, 2], measured[capture.has_height]
    scale = torch.linalg.lstsq(found[:, None], wanted[:, None]).solution
    assert float(scale) == pytest.approx(1.0, abs=1e-12)


def test_a_height_of_a_view_that_is_not_registered_does_not_count(survey_of, scene_of):
    survey = survey_of()
    height = survey.capture.height.clone()
    height[3] = 1e6
    capture = replace(survey.capture, height=height, has_height=torch.tensor([True, False, False, True]))
    scene = registered(scene_of(survey), True, True, True, False)

    fixed = fix_frame(scene, capture)

    assert float(fixed.views.center[0, 2]) == pytest.approx(30.0)


def test_through_water_without_measured_heights_the_first_camera_is_at_one(survey_of, scene_of):
    survey = survey_of()
    capture = replace(survey.capture, has_height=torch.zeros(4, dtype=torch.bool))

    fixed = fix_frame(scene_of(survey), capture)

    assert float(fixed.views.center[0, 2]) == pytest.approx(1.0)


@pytest.mark.parametrize(("measured", "expected"), [(True, 30.0), (False, 1.0)])
def test_in_air_the_first_camera_is_put_at_its_height_and_the_scale_is_left(survey_of, scene_of, measured, expected):
    survey = survey_of(index_ratio=1.0)
    scene = scene_of(survey)
    capture = replace(survey.capture, has_height=torch.tensor([measured, False, False, False]))

    fixed = fix_frame(scene, capture)

    assert float(fixed.views.center[0, 2]) == pytest.approx(expected)
    torch.testing.assert_close(torch.pdist(fixed.views.center), torch.pdist(scene.views.center))


def test_in_air_gravity_levels_the_frame(survey_of, scene_of):
    survey = survey_of(index_ratio=1.0)

    fixed = fix_frame(scene_of(survey), survey.capture)

    torch.testing.assert_close(-fixed.views.rotation[..., 2], survey.basin.down_in_cam, rtol=0.0, atol=1e-10)


def test_in_air_a_frame_upside_down_is_turned_and_not_mirrored(survey_of):
    survey = survey_of(index_ratio=1.0)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    zero = torch.zeros(3, dtype=torch.float64)
    scene = transformed(survey.scene(with_points=True), Similarity(torch.ones((), dtype=torch.float64), flip, zero))

    fixed = fix_frame(scene, survey.capture)

    torch.testing.assert_close(-fixed.views.rotation[..., 2], survey.basin.down_in_cam, rtol=0.0, atol=1e-10)
    torch.testing.assert_close(torch.linalg.det(fixed.views.rotation), torch.ones(4, dtype=torch.float64))


def test_views_that_are_not_registered_keep_their_identity(survey_of, scene_of):
    survey = survey_of()
    scene = registered(scene_of(survey), True, True, False, True)

    fixed = fix_frame(scene, survey.capture)

    assert torch.equal(fixed.views.rotation[2], scene.views.rotation[2])
    assert torch.equal(fixed.views.center[2], scene.views.center[2])


def test_a_model_without_images_is_left_alone(survey_of):
    survey = survey_of()
    scene = registered(survey.scene(), False, False, False, False)

    assert fix_frame(scene, survey.capture) is scene
