"""Poses without a starting value, through the water and without it."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import align_above_plane, align_similarity
from torchrefrac.ransac import RansacOptions
from torchrefrac.refraction import FlatInterface
from torchrefrac.sfm import PinholeInitializer, RefractiveInitializer, SfmOptions
from torchrefrac.sfm.pose import Resection, draws_of
from torchrefrac.sfm.rays import Rays

OPTIONS = SfmOptions(ransac=RansacOptions(max_error=2.0, max_samples=4096))
HARD = {"noise": 0.2, "outliers": 0.15, "gravity_error_deg": 0.5}
in_water_and_air = pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])


def make_initializer(survey):
    if survey.basin.index_ratio == 1.0:
        return PinholeInitializer(survey.capture, OPTIONS)
    return RefractiveInitializer(survey.capture, survey.basin.index_ratio, OPTIONS)


@in_water_and_air
def test_the_pose_of_a_pair_is_found_in_spite_of_outliers_and_gravity_that_is_off(survey_of, generator, index_ratio):
    survey = survey_of(cameras=2, points=300, index_ratio=index_ratio, **HARD)
    first, second, right, track = survey.common(0, 1)

    pose = make_initializer(survey).relative((0, 1), (first, second), generator)

    assert (pose.inliers & right).sum() > 0.95 * right.sum()
    assert (pose.inliers & ~right).sum() < 0.03 * pose.inliers.sum()
    truth = survey.basin.points[track[pose.inliers & right]]
    camera = RefractiveCamera(survey.basin.lens, pose.rotation, pose.center, FlatInterface(index_ratio))
    both = torch.stack((first, second), dim=1)[pose.inliers & right]
    points, _, _ = Rays.of(camera, both).meet(lambda points: points[..., 2])
    align = align_above_plane if index_ratio > 1.0 else align_similarity
    change = align(points, truth)
    assert (change.apply(points) - truth).norm(dim=-1).median() < 0.5
    assert (change.apply(pose.center) - survey.basin.center).norm(dim=-1).amax() < 1.0


@in_water_and_air
def test_the_median_angle_of_a_pair_is_that_between_its_rays(survey_of, generator, index_ratio):
    survey = survey_of(cameras=2, points=100, index_ratio=index_ratio)
    first, second, _, _ = survey.common(0, 1)

    pose = make_initializer(survey).relative((0, 1), (first, second), generator)

    cameras = survey.basin.cameras[:, None]
    directions = cameras.cast_rays(torch.stack((first, second)))[1]
    expected = torch.arccos((directions[0] * directions[1]).sum(dim=-1)).median()
    assert pose.median_angle == pytest.approx(float(expected), rel=1e-3)


def _seen_by(survey, image, pixels, track):
    """The true points of some tracks at these pixels of an image."""
    return Resection(image, survey.basin.lens, pixels, survey.basin.points[track])


@in_water_and_air
def test_the_pose_of_an_image_is_found_in_spite_of_outliers_and_gravity_that_is_off(survey_of, generator, index_ratio):
    survey = survey_of(cameras=2, points=200, index_ratio=index_ratio, **{**HARD, "outliers": 0.3})
    pixels, right, track = survey.common(1)

    pose = make_initializer(survey).absolute(_seen_by(survey, 1, pixels, track), generator)

    assert (pose.inliers & right).sum() > 0.98 * right.sum()
    assert (pose.inliers & ~right).sum() <= 1
    torch.testing.assert_close(pose.center, survey.basin.center[1], rtol=0.0, atol=0.1)
    torch.testing.assert_close(pose.rotation, survey.basin.rotation[1], rtol=0.0, atol=2e-3)


@in_water_and_air
def test_poses_of_some_images_are_those_that_each_has_alone(survey_of, index_ratio):
    survey = survey_of(cameras=3, points=150, index_ratio=index_ratio, **HARD)
    initializer = make_initializer(survey)
    seen = [(image, *survey.common(image)) for image in range(3)]
    images = [_seen_by(survey, image, pixels, track) for image, pixels, _, track in seen]
    images.append(images[0]._replace(pixels=images[0].pixels[:3], points=images[0].points[:3]))

    found = initializer.absolute_each(images, [draws_of(1, i) for i in range(4)])

    assert found[3] is None
    assert initializer.absolute_each([], []) == []
    for i, image in enumerate(images[:3]):
        alone = initializer.absolute(image, draws_of(1, i))
        assert torch.equal(found[i].inliers, alone.inliers)
        torch.testing.assert_close(found[i].center, alone.center, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(found[i].rotation, alone.rotation, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("count", [0, 5])
@in_water_and_air
def test_too_few_data_give_no_pose(survey_of, generator, index_ratio, count):
    survey = survey_of(cameras=2, index_ratio=index_ratio)
    first, second, _, track = survey.common(0, 1)
    initializer = make_initializer(survey)

    assert initializer.relative((0, 1), (first[:count], second[:count]), generator) is None
    assert initializer.absolute(_seen_by(survey, 0, first[:count], track[:count]), generator) is None


def test_random_pixels_give_no_pose_through_water_or_one_that_few_agree_with(survey_of, generator):
    survey = survey_of(cameras=2, points=100, outliers=1.0)
    first, second, _, track = survey.common(0, 1)
    initializer = make_initializer(survey)

    pair = initializer.relative((0, 1), (first, second), generator)
    single = initializer.absolute(_seen_by(survey, 1, second, track), generator)

    for pose in (pair, single):
        assert pose is None or pose.inliers.sum() < 20


@in_water_and_air
def test_the_same_seed_gives_the_same_poses_to_the_last_bit(survey_of, index_ratio):
    survey = survey_of(cameras=2, points=100, index_ratio=index_ratio, **HARD)
    first, second, _, track = survey.common(0, 1)
    initializer = make_initializer(survey)

    pairs = [initializer.relative((0, 1), (first, second), torch.Generator().manual_seed(5)) for _ in range(2)]
    known = _seen_by(survey, 1, second, track)
    singles = [initializer.absolute(known, torch.Generator().manual_seed(5)) for _ in range(2)]

    for one, two in (pairs, singles):
        assert torch.equal(one.center, two.center)
        assert torch.equal(one.inliers, two.inliers)


def test_gravity_that_is_known_to_be_vague_widens_the_search(survey_of, generator):
    survey = survey_of(cameras=2, points=200, noise=0.2, gravity_error_deg=3.0)
    pixels, _, track = survey.common(1)
    options = replace(OPTIONS, ransac=replace(OPTIONS.ransac, min_inliers=150))

    def find(capture):
        initializer = RefractiveInitializer(capture, survey.basin.index_ratio, options)
        return initializer.absolute(_seen_by(survey, 1, pixels, track), generator)

    assert find(survey.capture).inliers.sum() > 0.95 * len(pixels)
    assert find(replace(survey.capture, down_sigma=torch.full_like(survey.capture.height, 1e-6))) is None
