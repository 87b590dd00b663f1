"""Points from rays."""

import math

import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.minimal import triangulate, triangulation_angle


def test_the_rays_of_a_point_seen_through_water_meet_in_it(make_basin):
    basin = make_basin(20, cameras=3, points=10)
    pixels, _ = basin.project()
    origins, directions, _ = basin.cameras[:, :, None].cast_rays(pixels)

    points, valid = triangulate(origins.transpose(1, 2), directions.transpose(1, 2))

    assert valid.all()
    torch.testing.assert_close(points, basin.points, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("weighted", [False, True])
def test_rays_that_miss_each_other_give_the_point_of_least_squares(draw, weighted):
    origins, directions = draw.normal(50, 4, 3), draw.directions(50, 4)
    weights = draw.uniform(0.1, 3.0, 50, 4) if weighted else torch.ones(50, 4, dtype=torch.float64)

    points, valid = triangulate(origins, directions, weights if weighted else None)

    across = torch.eye(3, dtype=torch.float64) - directions[..., :, None] * directions[..., None, :]
    across = weights.sqrt()[..., None, None] * across
    rhs = (across @ origins[..., None]).flatten(1, 2)
    assert valid.all()
    torch.testing.assert_close(
        points, torch.linalg.lstsq(across.flatten(1, 2), rhs).solution[..., 0], rtol=0.0, atol=1e-9
    )


def test_a_ray_of_weight_zero_does_not_count(draw):
    origins, directions = draw.normal(20, 3, 3), draw.directions(20, 3)

    points, _ = triangulate(origins, directions, torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64).expand(20, 3))

    assert_matches(points, triangulate(origins[:, :2], directions[:, :2])[0], slack=100.0)


def test_only_the_proportion_of_weights_matters(draw):
    origins, directions, weights = draw.normal(20, 3, 3), draw.directions(20, 3), draw.uniform(0.5, 2.0, 20, 3)

    points, valid = triangulate(origins, directions, 1e-6 * weights)

    assert valid.all()
    assert_matches(points, triangulate(origins, directions, weights)[0], slack=100.0)


def test_the_order_of_rays_does_not_matter(draw):
    origins, directions, weights = draw.normal(20, 5, 3), draw.directions(20, 5), draw.uniform(0.5, 2.0, 20, 5)
    order = torch.tensor([3, 0, 4, 2, 1])

    points, _ = triangulate(origins[:, order], directions[:, order], weights[:, order])

    assert_matches(points, triangulate(origins, directions, weights)[0], slack=100.0)


def test_the_sense_of_a_direction_does_not_matter(draw):
    origins, directions = draw.normal(20, 3, 3), draw.directions(20, 3)

    assert_matches(triangulate(origins, -directions)[0], triangulate(origins, directions)[0], slack=100.0)


def test_far_from_the_origin_of_the_world_a_point_keeps_its_digits(draw):
    origins, directions = draw.normal(50, 3, 3), draw.directions(50, 3)
    shift = torch.tensor([4e6, 5e5, 1e3], dtype=torch.float64)

    points, _ = triangulate(origins + shift, directions)

    torch.testing.assert_close(points - shift, triangulate(origins, directions)[0], rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("opening_deg", [1e-2, 1e-1])
def test_rays_that_are_nearly_parallel_still_meet(opening_deg):
    half = math.radians(opening_deg) / 2.0
    target = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    directions = target.new_tensor([[math.sin(half), 0.0, -math.cos(half)], [-math.sin(half), 0.0, -math.cos(half)]])

    point, valid = triangulate(target - directions, directions)

    assert valid
    torch.testing.assert_close(point, target, rtol=0.0, atol=1e-6)


def test_parallel_rays_are_not_valid_and_give_the_mean_of_their_origins(draw):
    origins, direction = draw.normal(20, 3, 3), draw.directions(20, 1).expand(20, 3, 3)

    points, valid = triangulate(origins, direction)

    assert not valid.any()
    assert_matches(points, origins.mean(dim=1), slack=10.0)


def test_one_ray_alone_is_not_valid(draw):
    origins, directions = draw.normal(20, 2, 3), draw.directions(20, 2)

    points, valid = triangulate(origins, directions, torch.tensor([1.0, 0.0], dtype=torch.float64).expand(20, 2))

    assert not valid.any()
    assert_matches(points, origins[:, 0])


def test_no_ray_at_all_is_not_valid_and_finite(draw):
    points, valid = triangulate(draw.normal(4, 2, 3), draw.directions(4, 2), torch.zeros(4, 2, dtype=torch.float64))

    assert not valid.any()
    assert points.isfinite().all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_leading_dimensions_are_triangulated_one_by_one(draw, dtype):
    origins, directions = draw.normal(2, 5, 3, 3).to(dtype), draw.directions(2, 5, 3).to(dtype)

    points, valid = triangulate(origins, directions)

    assert points.dtype == dtype
    assert valid.shape == (2, 5)
    assert_matches(points[1, 3], triangulate(origins[1, 3], directions[1, 3])[0], slack=10.0)


@pytest.mark.parametrize(("origins", "directions"), [((4, 3), (5, 3)), ((4, 2), (4, 2))])
def test_rays_of_the_wrong_shape_are_refused(origins, directions):
    with pytest.raises(ValueError, match=r"must both be \(\*B, n, 3\)"):
        triangulate(torch.ones(origins), torch.ones(directions))


def test_the_triangulation_angle_is_the_largest_between_rays_that_are_present():
    angles = torch.deg2rad(torch.tensor([0.0, 10.0, 25.0, 70.0], dtype=torch.float64))
    directions = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), dim=-1).expand(3, 4, 3)
    present = torch.tensor([[True, True, True, True], [True, True, True, False], [False, True, True, False]])

    assert_matches(torch.rad2deg(triangulation_angle(directions, present)), angles.new_tensor([70.0, 25.0, 15.0]))


@pytest.mark.parametrize("present", [[True, False], [False, False]])
def test_fewer_than_two_rays_open_no_angle(draw, present):
    angle = triangulation_angle(draw.directions(2), torch.tensor(present))

    torch.testing.assert_close(angle, torch.zeros_like(angle), rtol=0.0, atol=1e-7)
