"""The absolute pose of a camera above water from two points, and from many."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from tests.minimal.pose_errors import WATER, absolute_error
from torchrefrac.geometry import heading_rotation
from torchrefrac.minimal import absolute_pose_2pt, absolute_pose_lsqi
from torchrefrac.refraction import FlatInterface, lift_points


@pytest.mark.parametrize("land", [0, 1, 2], ids=["water", "both", "land"])
def test_the_truth_is_among_the_candidates_in_999_problems_of_1000(make_view, land):
    rays, points, heading, center = make_view(1000, land=land)

    found_heading, found_center, valid = absolute_pose_2pt(rays, points, WATER)

    error = absolute_error(found_heading, found_center, heading[:, None], center[:, None])
    assert ((valid & (error < 1e-6)).any(dim=-1)).double().mean() >= 0.999


@pytest.mark.parametrize("land", [0, 1, 2], ids=["water", "both", "land"])
def test_every_valid_candidate_sees_both_points_along_their_rays(make_view, land):
    rays, points, _, _ = make_view(1000, land=land)

    heading, center, valid = absolute_pose_2pt(rays, points, WATER)

    assert valid[:, 1].any()
    offset, _ = lift_points(center[:, :, None], points[:, None], FlatInterface(WATER))
    seen = offset @ heading_rotation(heading).mT
    slope, expected = (v[..., :2] / v[..., 2:] for v in (seen, rays[:, None]))
    error = (slope - expected).norm(dim=-1).amax(dim=-1) / expected.norm(dim=-1).amax(dim=-1).clamp(min=1.0)
    assert (error[valid] < 1e-6).double().mean() >= 0.999


@pytest.mark.parametrize(
    ("points", "rays"),
    [
        ([[0.33, 0.83, -9.1], [0.37, 1.18, -1.15]], [[0.37, 0.32, -1.0], [0.51, 0.66, -1.0]]),
        ([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0]], [[0.0, 0.0, -1.0], [5.0, 0.0, -1.0]]),
    ],
    ids=["no heading", "only from below the water"],
)
def test_rays_that_no_camera_above_the_water_has_are_not_valid_and_finite(points, rays):
    points, rays = (torch.tensor(value, dtype=torch.float64) for value in (points, rays))

    heading, center, valid = absolute_pose_2pt(rays, points, WATER)

    assert not valid.any()
    assert heading.isfinite().all()
    assert center.isfinite().all()


@pytest.mark.parametrize(
    ("points", "rays"),
    [
        ([[1.0, 2.0, -1.0], [1.0, 2.0, -3.0]], [[0.1, 0.2, -1.0], [0.3, 0.1, -1.0]]),
        ([[1.0, 2.0, -1.0], [3.0, 2.0, -1.0]], [[0.1, 0.2, -1.0], [0.1, 0.2, -1.0]]),
        ([[1.0, 2.0, -1.0], [1.0, 2.0, -1.0]], [[0.1, 0.2, -1.0], [0.1, 0.2, -1.0]]),
    ],
    ids=["one vertical line", "one ray twice", "one point twice"],
)
def test_degenerate_pairs_are_not_valid_and_finite(points, rays):
    points, rays = (torch.tensor(value, dtype=torch.float64) for value in (points, rays))

    heading, center, valid = absolute_pose_2pt(rays, points, WATER)

    assert not valid.any()
    assert heading.isfinite().all()
    assert center.isfinite().all()


@pytest.mark.parametrize(("points", "land"), [(3, 0), (3, 3), (3, 1), (20, 0), (20, 20), (20, 7)])
def test_exact_rays_of_three_or_more_points_give_the_pose(make_view, points, land):
    rays, points, heading, center = make_view(100, points=points, land=land)

    found_heading, found_center, valid = absolute_pose_lsqi(rays, points, WATER)

    assert valid.all()
    assert absolute_error(found_heading, found_center, heading, center).amax() < 1e-10


@pytest.mark.parametrize("land", [0, 5], ids=["water", "both"])
def test_with_noise_the_pose_is_the_least_squares_one_over_all_headings(make_basin, draw, land):
    basin = make_basin(8, cameras=1, points=10, land=land)
    pixels, _ = basin.project()
    rays = basin.level_rays_of(pixels + 20.0 * draw.normal(*pixels.shape))[:, 0]
    weights = draw.uniform(0.2, 2.0, 8, 10)

    heading, center, valid = absolute_pose_lsqi(rays, basin.points, WATER, weights)

    assert valid.all()
    for i in range(8):
        best_heading, best_center = _best_pose(rays[i].numpy(), basin.points[i].numpy(), weights[i].numpy())
        assert abs(math.remainder(float(heading[i]) - best_heading, 2.0 * math.pi)) < 1e-5
        torch.testing.assert_close(center[i], torch.from_numpy(best_center), rtol=0.0, atol=1e-3)


def test_a_point_of_weight_zero_does_not_count(make_view):
    rays, points, heading, center = make_view(20, points=6)
    rays[:, 2] = rays[:, 2].new_tensor((3.0, -2.0, -1.0))
    weights = torch.ones(20, 6, dtype=torch.float64)
    weights[:, 2] = 0.0

    found_heading, found_center, _ = absolute_pose_lsqi(rays, points, WATER, weights)

    assert absolute_error(found_heading, found_center, heading, center).amax() < 1e-10


@pytest.mark.parametrize(("solve", "points"), [(absolute_pose_2pt, 2), (absolute_pose_lsqi, 6)])
def test_moving_the_points_above_the_plane_moves_the_camera_along(make_view, draw, solve, points):
    rays, points, heading, center = make_view(50, points=points, land=1)
    turn, shift = draw.uniform(-3.0, 3.0, 50), 50.0 * draw.normal(50, 3) * points.new_tensor((1.0, 1.0, 0.0))
    world = heading_rotation(turn)

    found_heading, found_center, _ = solve(rays, points @ world.mT + shift[:, None], WATER)

    moved = (world @ center[..., None])[..., 0] + shift
    error = absolute_error(
        found_heading.reshape(50, -1), found_center.reshape(50, -1, 3), (heading - turn)[:, None], moved[:, None]
    )
    assert error.amin(dim=-1).amax() < 1e-9


@pytest.mark.parametrize(("solve", "points"), [(absolute_pose_2pt, 2), (absolute_pose_lsqi, 6)])
def test_leading_dimensions_and_index_ratios_are_solved_one_by_one(make_view, draw, solve, points):
    rays, points, _, _ = make_view(2, 3, points=points)
    index = draw.uniform(1.2, 1.5, 2, 3)

    batch = solve(rays, points, index)

    for many, alone in zip(batch, solve(rays[1, 2], points[1, 2], index[1, 2]), strict=True):
        assert many.shape[:2] == (2, 3)
        torch.testing.assert_close(many[1, 2], alone, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("solve", "points"), [(absolute_pose_2pt, 2), (absolute_pose_lsqi, 20)])
def test_single_precision_stays_single(make_view, solve, points):
    rays, points, heading, center = make_view(20, points=points)

    found_heading, found_center, _ = solve(rays.float(), points.float(), WATER)

    assert found_heading.dtype == found_center.dtype == torch.float32
    found = found_heading.double().reshape(20, -1), found_center.double().reshape(20, -1, 3)
    assert absolute_error(*found, heading[:, None], center[:, None]).amin(dim=-1).amax() < 1e-2


def test_a_camera_below_the_water_is_not_valid(draw):
    center = torch.tensor([0.0, 0.0, -5.0], dtype=torch.float64)
    slope, depth = draw.uniform(-1.0, 1.0, 20, 6, 2), draw.uniform(-100.0, -40.0, 20, 6, 1)
    g = (WATER**2 + (WATER**2 - 1.0) * slope.square().sum(dim=-1, keepdim=True)).sqrt()
    points = torch.cat((center[:2] - slope * center[2] + depth * slope / g, depth), dim=-1)

    _, found, valid = absolute_pose_lsqi(torch.cat((slope, torch.ones_like(depth)), dim=-1), points, WATER)

    assert not valid.any()
    assert found.isfinite().all()


@pytest.mark.parametrize("land", [0, 1], ids=["water", "both"])
def test_without_refraction_the_poses_are_those_of_poselib(make_view, land):
    poselib = pytest.importorskip("poselib")
    rays, points, _, _ = make_view(100, land=land, index_ratio=1.0)
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # its vertical is y

    heading, center, valid = absolute_pose_2pt(rays, points, 1.0)

    for i in range(100):
        theirs = []
        for pose in poselib.up2p(rays[i].numpy() @ upright.T, points[i].numpy() @ upright.T):
            rotation = upright.T @ np.asarray(pose.R) @ upright
            place = -rotation.T @ upright.T @ np.asarray(pose.t)
            if place[2] > 0.0:
                theirs.append([rotation[0, 0], rotation[1, 0], *place])
        ours = torch.stack((heading[i].cos(), heading[i].sin(), *center[i].unbind(dim=-1)), dim=-1)[valid[i]]
        np.testing.assert_allclose(sorted(ours.tolist()), sorted(theirs), rtol=1e-7, atol=1e-7)


def _best_pose(rays, points, weights):
    """Heading and centre by searching all headings, the centre by ordinary least squares at each of them.

    Of a point that appears at p_z / g (where g belongs to its ray; p_z itself in air) the horizontal offset from the
    camera is its slope times the vertical one.
    """
    slope = rays[:, :2] / rays[:, 2:]
    g = np.sqrt(WATER**2 + (WATER**2 - 1.0) * (slope**2).sum(axis=1))
    apparent = np.where(points[:, 2] < 0.0, points[:, 2] / g, points[:, 2])

    def fit(heading):
        c, s = math.cos(heading), math.sin(heading)
        level = points[:, :2] @ np.array([[c, s], [-s, c]])
        system = np.zeros((len(points), 2, 3))
        system[:, 0, 0] = system[:, 1, 1] = 1.0
        system[:, :, 2] = -slope
        rhs = level - slope * apparent[:, None]
        a, b = (weights[:, None, None] * system).reshape(-1, 3), (weights[:, None] * rhs).reshape(-1)
        center = np.linalg.lstsq(a, b, rcond=None)[0]
        return ((a @ center - b) ** 2).sum(), np.append(np.array([[c, s], [-s, c]]) @ center[:2], center[2])

    grid = np.linspace(-math.pi, math.pi, 361)
    start = grid[np.argmin([fit(heading)[0] for heading in grid])]
    bounds = (start - 0.02, start + 0.02)
    heading = minimize_scalar(lambda x: fit(x)[0], bounds=bounds, method="bounded", options={"xatol": 1e-10}).x
    return heading, fit(heading)[1]
