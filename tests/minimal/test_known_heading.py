"""Centres of cameras whose heading is known."""

import math

import pytest
import torch

from tests.minimal.pose_errors import HEIGHT, WATER, depth_of_meeting
from tests.tolerances import assert_matches
from torchrefrac.geometry import heading_rotation
from torchrefrac.minimal import absolute_pose_known_heading, relative_pose_3pt, relative_pose_4pt
from torchrefrac.minimal.known_heading import unchecked_absolute_pose_known_heading, unchecked_relative_pose_3pt


def test_three_exact_pairs_give_the_centre_in_999_problems_of_1000(make_pair):
    rays1, rays2, heading, center = make_pair(1000, points=3)

    found, valid = relative_pose_3pt(rays1, rays2, heading, WATER, HEIGHT)

    assert (valid & ((found - center).norm(dim=-1) < 1e-6 * HEIGHT)).double().mean() >= 0.999


def test_all_three_points_of_a_valid_centre_lie_below_the_water(make_pair):
    rays1, rays2, heading, _ = make_pair(1000, points=3, noise=10.0)

    center, valid = relative_pose_3pt(rays1, rays2, heading, WATER)

    assert 0.1 < valid.double().mean() < 0.9
    assert (depth_of_meeting(rays1[valid], rays2[valid], heading[valid], center[valid]) > 0.0).all()
    assert (center[valid][:, 2] > 0.0).all()


def test_turning_the_first_camera_turns_the_second_about_it(make_pair, draw):
    rays1, rays2, heading, center = make_pair(50, points=3)
    turn = draw.uniform(-math.pi, math.pi, 50)
    world = heading_rotation(turn)

    found, _ = relative_pose_3pt(rays1 @ world.mT, rays2, heading - turn, WATER, HEIGHT)

    torch.testing.assert_close(found, (world @ center[..., None])[..., 0], rtol=1e-8, atol=1e-8)


def test_the_height_of_the_first_camera_sets_the_scale(make_pair, draw):
    rays1, rays2, heading, _ = make_pair(20, points=3)
    height = draw.uniform(0.1, 50.0, 20)

    center, valid = relative_pose_3pt(rays1, rays2, heading, WATER, height)

    assert valid.all()
    assert_matches(center, height[:, None] * relative_pose_3pt(rays1, rays2, heading, WATER)[0])


def test_the_right_heading_makes_three_noisy_pairs_at_least_1_5_times_better_than_four_without_it(make_pair):
    rays1, rays2, heading, center = make_pair(500, points=4, noise=0.3)

    found, valid = relative_pose_3pt(rays1[:, :3], rays2[:, :3], heading, WATER, HEIGHT)

    _, four, four_valid = relative_pose_4pt(rays1, rays2, WATER, HEIGHT)
    error = torch.where(valid, (found - center).norm(dim=-1), torch.inf)
    four_error = torch.where(four_valid, (four - center[:, None]).norm(dim=-1), torch.inf).amin(dim=-1)
    assert 1.5 * error.median() < four_error.median()


@pytest.mark.parametrize("chosen", [(0, 0, 0), (0, 1, 0)], ids=["one", "two"])
def test_fewer_than_three_different_points_give_no_valid_centre_and_finite_numbers(make_pair, draw, chosen):
    rays1, rays2, heading, _ = make_pair(500, points=3)
    rays1, rays2 = (rays[:, list(chosen)] * draw.power_of_ten(-2.0, 2.0, 500, 3, 1) for rays in (rays1, rays2))

    center, valid = relative_pose_3pt(rays1, rays2, heading, WATER)

    assert center.isfinite().all()
    assert not valid.any()


@pytest.mark.parametrize("ratio", [1.0, WATER], ids=["air", "water"])
def test_degenerate_pairs_give_finite_numbers(make_pair, ratio):
    rays1, rays2, heading, _ = make_pair(5, points=3)
    rays2[0] = rays1[0]
    rays1[1, :, 1] = rays2[1, :, 1] = 0.0
    rays1[2, 0, 2] = 0.0
    rays1[3], rays2[3] = (rays1.new_tensor((0.0, 0.0, -1.0)),) * 2

    center, _ = relative_pose_3pt(rays1, rays2, heading, ratio)

    assert center.isfinite().all()


@pytest.mark.parametrize("camera", [0, 1])
def test_a_ray_upward_makes_the_centre_invalid(make_pair, camera):
    *rays, heading, _ = make_pair(50, points=3)
    rays[camera][:, 2] = -rays[camera][:, 2]

    assert not relative_pose_3pt(*rays, heading, WATER)[1].any()


@pytest.mark.parametrize(("points", "land"), [(2, 0), (2, 1), (2, 2), (20, 0), (20, 7), (20, 20)])
def test_exact_rays_of_two_or_more_points_give_the_centre(make_view, points, land):
    rays, points, heading, center = make_view(200, points=points, land=land)

    found, valid = absolute_pose_known_heading(rays, points, heading, WATER)

    assert valid.all()
    torch.testing.assert_close(found, center, rtol=1e-9, atol=1e-9)


def test_with_noise_the_centre_is_the_dense_least_squares_one(make_basin, draw):
    basin = make_basin(20, cameras=1, points=10, land=4)
    pixels, _ = basin.project()
    rays = basin.level_rays_of(pixels + 20.0 * draw.normal(*pixels.shape))[:, 0]
    heading, weights = basin.heading[:, 0], draw.uniform(0.2, 2.0, 20, 10)

    found, valid = absolute_pose_known_heading(rays, basin.points, heading, WATER, weights)

    assert valid.all()
    slope = (rays @ heading_rotation(heading))[..., :2] / rays[..., 2:]
    g = (WATER**2 + (WATER**2 - 1.0) * slope.square().sum(dim=-1)).sqrt()
    z = torch.where(basin.points[..., 2] < 0.0, basin.points[..., 2] / g, basin.points[..., 2])
    unit = torch.eye(2, dtype=torch.float64).expand(20, 10, 2, 2)
    system = weights[..., None, None] * torch.cat((unit, -slope[..., None]), dim=-1)
    target = weights[..., None] * (basin.points[..., :2] - slope * z[..., None])
    expected = torch.linalg.lstsq(system.flatten(1, 2), target.flatten(1, 2)[..., None]).solution[..., 0]
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_a_point_of_weight_zero_does_not_count(make_view):
    rays, points, heading, center = make_view(20, points=4)
    rays[:, 2] = rays.new_tensor((3.0, -2.0, -1.0))
    weights = torch.ones(20, 4, dtype=torch.float64)
    weights[:, 2] = 0.0

    found, _ = absolute_pose_known_heading(rays, points, heading, WATER, weights)

    torch.testing.assert_close(found, center, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_points_on_one_ray_or_without_weight_give_no_valid_centre_and_finite_numbers(make_view, draw, weight):
    rays, points, heading, _ = make_view(50, points=5)
    rays = rays[:, :1] * draw.power_of_ten(-2.0, 2.0, 50, 5, 1)

    center, valid = absolute_pose_known_heading(rays, points, heading, WATER, torch.full((50, 5), weight).double())

    assert center.isfinite().all()
    assert not valid.any()


def test_a_camera_below_the_water_is_not_valid(make_view):
    rays, points, heading, _ = make_view(50, points=5, land=5)

    center, valid = absolute_pose_known_heading(rays, points * points.new_tensor((1.0, 1.0, 0.0)), heading, WATER)
    below, below_valid = absolute_pose_known_heading(rays, points - points.new_tensor((0.0, 0.0, 1000.0)), heading, 1.0)

    assert valid.any()
    assert (center[valid][:, 2] > 0.0).all()
    assert not below_valid.any()
    assert below.isfinite().all()


def test_leading_dimensions_are_solved_one_by_one(make_pair, make_view):
    rays1, rays2, heading, _ = make_pair(2, 3, points=3)
    relative = relative_pose_3pt(rays1, rays2, heading, WATER)
    alone = relative_pose_3pt(rays1[1, 2], rays2[1, 2], float(heading[1, 2]), WATER)
    assert_matches(relative[0][1, 2], alone[0], slack=100.0)

    rays, points, heading, _ = make_view(2, 3)
    absolute = absolute_pose_known_heading(rays, points, heading, WATER)
    alone = absolute_pose_known_heading(rays[1, 2], points[1, 2], float(heading[1, 2]), WATER)
    assert_matches(absolute[0][1, 2], alone[0], slack=100.0)
    for center, valid in (relative, absolute):
        assert (center.shape, valid.shape) == ((2, 3, 3), (2, 3))


def test_single_precision_stays_single(make_pair, make_view):
    rays1, rays2, heading, center = make_pair(50, points=3)
    found, _ = relative_pose_3pt(rays1.float(), rays2.float(), heading.float(), WATER, HEIGHT)
    assert found.dtype == torch.float32
    assert (found.double() - center).norm(dim=-1).median() < 0.01

    rays, points, heading, center = make_view(50, points=5)
    found, _ = absolute_pose_known_heading(rays.float(), points.float(), heading.float(), WATER)
    assert found.dtype == torch.float32
    assert (found.double() - center).norm(dim=-1).amax() < 0.01


def test_without_checks_the_results_are_the_same(make_pair, make_view):
    pair, view = make_pair(10, points=3)[:3], make_view(10)[:3]

    for checked, bare, data in (
        (relative_pose_3pt, unchecked_relative_pose_3pt, pair),
        (absolute_pose_known_heading, unchecked_absolute_pose_known_heading, view),
    ):
        for expected, found in zip(checked(*data, WATER), bare(*data, WATER), strict=True):
            assert torch.equal(found, expected)
