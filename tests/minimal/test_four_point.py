"""The minimal relative pose of two cameras above one water surface."""

import math

import pytest
import torch

from tests.minimal.pose_errors import HEIGHT, WATER, depth_of_meeting, relative_error, sine_of_missing
from tests.tolerances import assert_matches
from torchrefrac.geometry import heading_rotation
from torchrefrac.minimal import relative_pose_4pt, relative_pose_7pt
from torchrefrac.minimal.four_point import unchecked_relative_pose_4pt


def test_the_truth_is_among_the_candidates_in_999_problems_of_1000(make_pair):
    rays1, rays2, heading, center = make_pair(1000, points=4)

    found = relative_pose_4pt(rays1, rays2, WATER, HEIGHT)

    assert (_error_of_the_best(found, heading, center) < 1e-6).double().mean() >= 0.999


def test_valid_candidates_meet_every_pair_below_the_water_from_above_it(make_pair):
    rays1, rays2, _, _ = make_pair(1000, points=4)

    heading, center, valid = relative_pose_4pt(rays1, rays2, WATER, HEIGHT)

    problem, candidate = valid.nonzero(as_tuple=True)
    assert len(problem) > 1000
    pairs = rays1[problem], rays2[problem], heading[problem, candidate], center[problem, candidate]
    missing = sine_of_missing(*pairs, HEIGHT).abs().amax(dim=-1)
    assert missing.quantile(0.999) < 1e-12
    assert missing.amax() < 1e-7
    assert (depth_of_meeting(*pairs, HEIGHT) > 0.0).all()
    assert (center[problem, candidate, 2] > 0.0).all()


def test_candidates_are_the_same_where_their_numbers_may_not_be_looked_at(make_pair):
    """Then all of them are polished, not the valid ones alone: here because a derivative is wanted."""
    rays1, rays2, _, _ = make_pair(200, points=4)
    rays2 = torch.cat((rays2[:150], rays2[150:].flip(0)))

    heading, center, valid = relative_pose_4pt(rays1, rays2, WATER)
    whole = relative_pose_4pt(rays1.clone().requires_grad_(), rays2, WATER)

    assert torch.equal(whole[2], valid)
    torch.testing.assert_close(whole[0].detach()[valid], heading[valid], rtol=0.0, atol=1e-10)
    torch.testing.assert_close(whole[1].detach()[valid], center[valid], rtol=1e-9, atol=1e-9)


def test_no_problem_has_more_than_six_candidates_and_none_has_one_twice(make_pair):
    rays1, rays2, _, _ = make_pair(1000, points=4)

    heading, center, valid = relative_pose_4pt(rays1, rays2, WATER)

    assert heading.shape == valid.shape == (1000, 8)
    assert not valid[:, 6:].any()
    pose = torch.cat((heading.cos()[..., None], heading.sin()[..., None], center), dim=-1)
    apart = (pose[:, :, None] - pose[:, None]).norm(dim=-1) + 9.0 * torch.eye(8, dtype=torch.float64)
    both = valid[:, :, None] & valid[:, None]
    assert apart[both].amin() > 1e-6


def test_the_height_of_the_first_camera_sets_the_scale(make_pair, draw):
    rays1, rays2, _, _ = make_pair(20, points=4)
    height = draw.uniform(0.1, 50.0, 20)

    heading, center, valid = relative_pose_4pt(rays1, rays2, WATER, height)

    unit_heading, unit_center, unit_valid = relative_pose_4pt(rays1, rays2, WATER)
    assert torch.equal(heading, unit_heading)
    assert torch.equal(valid, unit_valid)
    assert_matches(center[valid], (height[:, None, None] * unit_center)[valid])


def test_the_length_of_a_ray_does_not_matter(make_pair, draw):
    rays1, rays2, heading, center = make_pair(50, points=4)

    scaled = (rays * draw.power_of_ten(-2.0, 2.0, 50, 4, 1) for rays in (rays1, rays2))
    found = relative_pose_4pt(*scaled, WATER, HEIGHT)

    assert _error_of_the_best(found, heading, center).amax() < 1e-8


def test_turning_the_first_camera_turns_the_second_about_it(make_pair, draw):
    rays1, rays2, heading, center = make_pair(50, points=4)
    turn = heading_rotation(angle := draw.uniform(-math.pi, math.pi, 50))

    found = relative_pose_4pt(rays1 @ turn.mT, rays2, WATER, HEIGHT)

    assert _error_of_the_best(found, heading - angle, (turn @ center[..., None])[..., 0]).amax() < 1e-8


def test_turning_the_second_camera_adds_to_its_heading_alone(make_pair, draw):
    rays1, rays2, heading, center = make_pair(50, points=4)
    turn = draw.uniform(-math.pi, math.pi, 50)

    found = relative_pose_4pt(rays1, rays2 @ heading_rotation(turn).mT, WATER, HEIGHT)

    assert _error_of_the_best(found, heading + turn, center).amax() < 1e-8


def test_leading_dimensions_are_solved_one_by_one(make_pair):
    rays1, rays2, _, _ = make_pair(2, 3, points=4)

    heading, center, valid = relative_pose_4pt(rays1, rays2, WATER, HEIGHT)

    assert (heading.shape, center.shape, valid.shape) == ((2, 3, 8), (2, 3, 8, 3), (2, 3, 8))
    alone = relative_pose_4pt(rays1[1, 2], rays2[1, 2], WATER, HEIGHT)
    first, second = valid[1, 2], alone[2]
    assert_matches(heading[1, 2][first].sort().values, alone[0][second].sort().values, slack=1e4)
    assert relative_pose_4pt(rays1[:, :0], rays2[:, :0], WATER)[0].shape == (2, 0, 8)


def test_every_problem_may_have_its_own_index_ratio(make_basin):
    basins = [make_basin(points=4, index_ratio=ratio) for ratio in (1.33, 1.47)]
    rays1, rays2 = torch.stack([basin.level_rays() for basin in basins]).unbind(dim=1)
    heading, center = (torch.stack(part) for part in zip(*(b.second_from_first() for b in basins), strict=True))

    found = relative_pose_4pt(rays1, rays2, torch.tensor([1.33, 1.47], dtype=torch.float64), HEIGHT)

    assert _error_of_the_best(found, heading, center).amax() < 1e-8


def test_single_precision_stays_single(make_pair):
    rays1, rays2, heading, center = make_pair(200, points=4)

    found = relative_pose_4pt(rays1.float(), rays2.float(), WATER, HEIGHT)

    assert found[0].dtype == found[1].dtype == torch.float32
    error = _error_of_the_best((found[0].double(), found[1].double(), found[2]), heading, center)
    assert error.median() < 1e-4
    assert (error < 1e-2).double().mean() >= 0.98


def test_on_the_same_noisy_rays_four_points_are_at_least_1_8_times_better_than_seven(make_pair):
    rays1, rays2, _, center = make_pair(1000, points=7, noise=0.3)

    def median_error(solve, count):
        _, found, valid = solve(rays1[:, :count], rays2[:, :count], WATER, HEIGHT)
        error = torch.where(valid, (found - center[:, None]).norm(dim=-1), torch.inf)
        return error.amin(dim=-1).median()

    assert 1.8 * median_error(relative_pose_4pt, 4) < median_error(relative_pose_7pt, 7)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("chosen", [(0, 0, 0, 0), (0, 1, 0, 1), (0, 1, 0, 2)], ids=["one", "two", "three"])
def test_fewer_than_four_different_points_give_no_valid_pose_and_finite_numbers(make_pair, draw, chosen, dtype):
    rays1, rays2, _, _ = make_pair(500, points=4)
    rays1, rays2 = (
        (rays[:, list(chosen)] * draw.power_of_ten(-2.0, 2.0, 500, 4, 1)).to(dtype) for rays in (rays1, rays2)
    )

    heading, center, valid = relative_pose_4pt(rays1, rays2, WATER)

    assert heading.isfinite().all()
    assert center.isfinite().all()
    assert not valid.any()


@pytest.mark.parametrize("ratio", [1.0, WATER], ids=["air", "water"])
def test_degenerate_rays_give_finite_numbers(make_pair, ratio):
    rays1, rays2, _, _ = make_pair(5, points=4)
    rays2[0] = rays1[0]  # the second camera stands where the first does
    rays1[1, :, 1] = rays2[1, :, 1] = 0.0  # all in the vertical plane through both centres
    rays1[2, 0, 2] = 0.0  # along the surface
    rays1[3], rays2[3] = (rays1.new_tensor((0.0, 0.0, -1.0)),) * 2  # straight down

    heading, center, valid = relative_pose_4pt(rays1, rays2, ratio)

    assert heading.isfinite().all()
    assert center.isfinite().all()
    assert not valid[:4].any()


@pytest.mark.parametrize("camera", [0, 1])
def test_a_ray_upward_makes_every_candidate_invalid(make_pair, camera):
    rays = make_pair(50, points=4)[:2]
    rays[camera][:, 2] = -rays[camera][:, 2]

    assert not relative_pose_4pt(*rays, WATER)[2].any()


def test_without_checks_the_results_are_the_same_and_a_nan_spoils_its_own_problem_alone(make_pair):
    rays1, rays2, _, _ = make_pair(10, points=4)
    checked = relative_pose_4pt(rays1, rays2, WATER, HEIGHT)
    rays1[3, 1, 0] = math.nan

    for expected, found in zip(checked, unchecked_relative_pose_4pt(rays1, rays2, WATER, HEIGHT), strict=True):
        others = torch.arange(10) != 3
        assert torch.equal(found[others], expected[others])
        assert not (found[3].any() if found.dtype == torch.bool else found[3].isnan().any())


def _error_of_the_best(found, heading, center):
    """Error (*B) of the valid candidate that is nearest to the truth."""
    error = relative_error(found[0], found[1], heading[..., None], center[..., None, :])
    return torch.where(found[2], error, torch.inf).amin(dim=-1)
