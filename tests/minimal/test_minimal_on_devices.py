"""Closed-form solvers on other devices than the CPU."""

import pytest
import torch

from tests.made_device import on_every_device
from tests.minimal.pose_errors import HEIGHT, WATER
from torchrefrac.minimal import (
    absolute_pose_2pt,
    absolute_pose_known_heading,
    absolute_pose_lsqi,
    relative_pose_3pt,
    relative_pose_4pt,
    relative_pose_7pt,
    relative_pose_npt,
    triangulate,
)

OF_PAIRS = {relative_pose_4pt: 4, relative_pose_7pt: 7, relative_pose_npt: 12}
OF_VIEWS = {absolute_pose_2pt: 2, absolute_pose_lsqi: 8}


@on_every_device
@pytest.mark.parametrize("solve", OF_PAIRS)
def test_relative_poses_are_those_of_the_cpu(make_pair, solve, device):
    rays1, rays2, _, _ = make_pair(50, points=OF_PAIRS[solve], noise=0.3)

    _assert_same(solve(rays1.to(device), rays2.to(device), WATER, HEIGHT), solve(rays1, rays2, WATER, HEIGHT), device)


@on_every_device
@pytest.mark.parametrize("solve", OF_VIEWS)
def test_absolute_poses_are_those_of_the_cpu(make_view, solve, device):
    rays, points, _, _ = make_view(50, points=OF_VIEWS[solve])

    _assert_same(solve(rays.to(device), points.to(device), WATER), solve(rays, points, WATER), device)


@on_every_device
def test_poses_of_known_heading_are_those_of_the_cpu(make_pair, make_view, device):
    rays1, rays2, turned, _ = make_pair(50, points=3)
    rays, points, heading, _ = make_view(50)

    for solve, data in (
        (relative_pose_3pt, (rays1, rays2, turned)),
        (absolute_pose_known_heading, (rays, points, heading)),
    ):
        _assert_same(solve(*(part.to(device) for part in data), WATER), solve(*data, WATER), device)


@on_every_device
def test_points_are_those_of_the_cpu(draw, device):
    origins, directions = draw.normal(50, 3, 3), draw.directions(50, 3)

    _assert_same(triangulate(origins.to(device), directions.to(device)), triangulate(origins, directions), device)


def _assert_same(there, here, device):
    """Of the candidates that are valid."""
    valid = here[-1]
    assert torch.equal(there[-1].cpu(), valid)
    for one, other in zip(there[:-1], here[:-1], strict=True):
        assert one.device.type == device
        torch.testing.assert_close(one.cpu()[valid], other[valid], rtol=1e-10, atol=1e-10)
