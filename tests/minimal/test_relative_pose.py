"""The linear relative pose of two cameras above one water surface."""

import math

import pytest
import torch

from tests.minimal.pose_errors import HEIGHT, WATER, angle, depth_of_meeting, relative_error
from tests.tolerances import assert_matches
from torchrefrac.geometry import heading_rotation
from torchrefrac.minimal import relative_pose_7pt, relative_pose_npt
from torchrefrac.minimal.rays import bent
from torchrefrac.minimal.relative_pose import pose_rows


@pytest.mark.parametrize(("solve", "points"), [(relative_pose_7pt, 7), (relative_pose_npt, 30)])
def test_exact_rays_give_the_pose_in_999_problems_of_1000(make_pair, solve, points):
    rays1, rays2, heading, center = make_pair(1000, points=points)

    found_heading, found_center, valid = solve(rays1, rays2, WATER, HEIGHT)

    error = relative_error(found_heading[:, 0], found_center[:, 0], heading, center)
    assert (valid[:, 0] & (error < 1e-6)).double().mean() >= 0.999


def test_every_row_vanishes_at_the_true_pose(make_pair):
    rays1, rays2, heading, center = make_pair(100)
    (x, y, z), (c, s) = (center / HEIGHT).unbind(dim=-1), (heading.cos(), heading.sin())

    rows = pose_rows(bent(rays1, WATER), bent(rays2, WATER))

    pose = torch.stack((c, s, z * c, z * s, c * x - s * y, s * x + c * y, x, y), dim=-1)
    residual = (rows @ pose[..., None])[..., 0] / (rows.norm(dim=-1) * pose.norm(dim=-1, keepdim=True))
    torch.testing.assert_close(residual, torch.zeros_like(residual), rtol=0.0, atol=1e-14)


def test_with_noise_the_consistent_candidate_comes_first(make_pair):
    rays1, rays2, true_heading, _ = make_pair(200, points=30, noise=0.3)

    heading, _, _ = relative_pose_npt(rays1, rays2, WATER, HEIGHT)

    error = angle(heading - true_heading[:, None])
    assert (error[:, 0] < error[:, 1]).all()


def test_the_other_candidate_looks_the_opposite_way(make_pair):
    rays1, rays2, _, _ = make_pair(20)

    heading, _, _ = relative_pose_7pt(rays1, rays2, WATER)

    assert_matches(angle(heading[:, 1] - heading[:, 0]), torch.full((20,), math.pi, dtype=torch.float64))


def test_the_height_of_the_first_camera_sets_the_scale(make_pair, draw):
    rays1, rays2, _, _ = make_pair(20)
    height = draw.uniform(0.1, 50.0, 20)

    heading, center, valid = relative_pose_7pt(rays1, rays2, WATER, height)

    unit_heading, unit_center, _ = relative_pose_7pt(rays1, rays2, WATER)
    assert torch.equal(heading, unit_heading)
    assert_matches(center[valid], (height[:, None, None] * unit_center)[valid])


def test_a_pair_of_weight_zero_does_not_count(make_pair):
    rays1, rays2, heading, center = make_pair(20, points=10)
    rays2[:, 4] = rays2[:, 4].new_tensor((3.0, -2.0, -1.0))
    weights = torch.ones(20, 10, dtype=torch.float64)
    weights[:, 4] = 0.0

    found_heading, found_center, valid = relative_pose_npt(rays1, rays2, WATER, HEIGHT, weights)

    assert valid[:, 0].all()
    assert relative_error(found_heading[:, 0], found_center[:, 0], heading, center).amax() < 1e-8


def test_a_pair_given_twice_counts_as_one_of_weight_root_two(make_pair):
    rays1, rays2, _, _ = make_pair(20, points=12, noise=0.3)
    weights = torch.ones(20, 12, dtype=torch.float64)
    weights[:, 0] = math.sqrt(2.0)

    weighted = relative_pose_npt(rays1, rays2, WATER, HEIGHT, weights)

    twice = [torch.cat((rays, rays[:, :1]), dim=1) for rays in (rays1, rays2)]
    for actual, expected in zip(weighted, relative_pose_npt(*twice, WATER, HEIGHT), strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-8, atol=1e-8)


def test_the_length_of_a_ray_does_not_matter(make_pair, draw):
    rays1, rays2, heading, center = make_pair(20)

    scaled = (rays * draw.power_of_ten(-2.0, 2.0, 20, 7, 1) for rays in (rays1, rays2))
    found_heading, found_center, _ = relative_pose_7pt(*scaled, WATER, HEIGHT)

    assert relative_error(found_heading[:, 0], found_center[:, 0], heading, center).amax() < 1e-8


def test_of_seven_pairs_one_with_rays_upward_makes_both_candidates_invalid(make_pair):
    rays1, rays2, _, _ = make_pair(20)
    rays2[:, 3] = -rays2[:, 3]

    assert not relative_pose_7pt(rays1, rays2, WATER)[2].any()
    assert relative_pose_npt(rays1, rays2, WATER)[2][:, 0].all()


def test_all_seven_points_of_a_valid_candidate_lie_below_the_water(make_pair):
    rays1, rays2, _, _ = make_pair(1000, noise=3.0)

    heading, center, valid = relative_pose_7pt(rays1, rays2, WATER)

    at, candidate = valid.nonzero(as_tuple=True)
    depth = depth_of_meeting(rays1[at], rays2[at], heading[at, candidate], center[at, candidate])
    assert valid.any()
    assert (depth > 0.0).all()
    assert valid.sum() < relative_pose_npt(rays1, rays2, WATER)[2].sum()


def test_turning_the_first_camera_turns_the_second_about_it(make_pair, draw):
    rays1, rays2, heading, center = make_pair(50)
    turn = draw.uniform(-math.pi, math.pi, 50)

    found_heading, found_center, _ = relative_pose_7pt(rays1 @ heading_rotation(turn).mT, rays2, WATER, HEIGHT)

    turned = (heading_rotation(turn) @ center[..., None])[..., 0]
    assert relative_error(found_heading[:, 0], found_center[:, 0], heading - turn, turned).amax() < 1e-8


def test_turning_the_second_camera_adds_to_its_heading_alone(make_pair, draw):
    rays1, rays2, heading, center = make_pair(50)
    turn = draw.uniform(-math.pi, math.pi, 50)

    found_heading, found_center, _ = relative_pose_7pt(rays1, rays2 @ heading_rotation(turn).mT, WATER, HEIGHT)

    assert relative_error(found_heading[:, 0], found_center[:, 0], heading + turn, center).amax() < 1e-8


def test_leading_dimensions_are_solved_one_by_one(make_pair):
    rays1, rays2, _, _ = make_pair(2, 3)

    heading, center, valid = relative_pose_7pt(rays1, rays2, WATER, HEIGHT)

    assert (heading.shape, center.shape, valid.shape) == ((2, 3, 2), (2, 3, 2, 3), (2, 3, 2))
    for batch, alone in zip(
        (heading, center, valid), relative_pose_7pt(rays1[1, 2], rays2[1, 2], WATER, HEIGHT), strict=True
    ):
        torch.testing.assert_close(batch[1, 2], alone, rtol=1e-9, atol=1e-9)


def test_every_problem_may_have_its_own_index_ratio(make_basin):
    fresh, oil = (make_basin(points=9, index_ratio=ratio) for ratio in (1.33, 1.47))
    rays1, rays2 = torch.stack((fresh.level_rays(), oil.level_rays())).unbind(dim=1)

    heading, center, _ = relative_pose_npt(rays1, rays2, torch.tensor([1.33, 1.47], dtype=torch.float64), HEIGHT)

    for i, basin in enumerate((fresh, oil)):
        assert relative_error(heading[i, 0], center[i, 0], *basin.second_from_first()) < 1e-8


def test_single_precision_stays_single(make_pair):
    rays1, rays2, heading, center = make_pair(20, points=100)

    found = relative_pose_npt(rays1.float(), rays2.float(), WATER, HEIGHT)

    assert found[0].dtype == found[1].dtype == torch.float32
    assert relative_error(found[0][:, 0].double(), found[1][:, 0].double(), heading, center).amax() < 0.05


def test_500_noisy_pairs_give_a_pose_five_times_better_than_seven_of_them(make_pair):
    rays1, rays2, heading, center = make_pair(50, points=500, noise=0.3)

    def median_error(count):
        found = relative_pose_npt(rays1[:, :count], rays2[:, :count], WATER, HEIGHT)
        return relative_error(found[0][:, 0], found[1][:, 0], heading, center).median()

    assert median_error(500) < 0.05
    assert median_error(500) < 0.2 * median_error(7)


def test_a_second_camera_below_the_water_is_not_valid(make_basin, draw):
    basin = make_basin(20)
    center = basin.center[:, 1] * basin.center.new_tensor((1.0, 1.0, -1.0))
    slope, depth = draw.uniform(-1.0, 1.0, 20, 7, 2), draw.uniform(-100.0, -40.0, 20, 7, 1)
    g = (WATER**2 + (WATER**2 - 1.0) * slope.square().sum(dim=-1, keepdim=True)).sqrt()
    points = torch.cat((center[:, None, :2] - slope * center[:, None, 2:] + depth * slope / g, depth), dim=-1)
    rays2 = torch.cat((slope, torch.ones_like(depth)), dim=-1)
    seen = type(basin)(basin.lens, WATER, basin.rotation[:, :1], basin.center[:, :1], points)

    _, found_center, valid = relative_pose_7pt(seen.level_rays()[:, 0], rays2, WATER, HEIGHT)

    assert not valid.any()
    assert found_center.isfinite().all()


@pytest.mark.parametrize("ratio", [1.0, WATER], ids=["air", "water"])
def test_degenerate_rays_give_finite_numbers(make_pair, ratio):
    rays1, rays2, _, _ = make_pair(3, points=8)
    rays1[0], rays2[0] = rays1[0, :1], rays2[0, :1]  # one point eight times
    rays1[1, :, 1] = rays2[1, :, 1] = 0.0  # all in the vertical plane through both centres

    heading, center, _ = relative_pose_npt(rays1, rays2, ratio)

    assert heading.isfinite().all()
    assert center.isfinite().all()
