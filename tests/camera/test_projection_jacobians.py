"""Derivatives of the projection: closed form, autograd and finite differences."""

import math
from dataclasses import replace

import pytest
import torch
from tolerances import assert_matches

from torchrefrac.camera import ProjectionJacobians, RefractiveCamera
from torchrefrac.geometry import so3_exp
from torchrefrac.refraction import FlatInterface

COUNT = 6


@pytest.fixture
def view(draw, make_camera, points_seen):
    """`view(place)`: a batch of cameras and the points that they look at, at an ordinary or a degenerate place."""

    def make(place):
        if place == "grazing":
            return _grazing(make_camera(COUNT))
        camera = make_camera(COUNT, index_ratio=1.0 if place == "index ratio 1" else 1.333)
        points = points_seen(camera, COUNT, land=place == "land")
        if place == "nadir":
            points[:, :2] = camera.center_in_world[:, :2]
        return camera, points

    return make


at_every_place = pytest.mark.parametrize("place", ["water", "land", "nadir", "grazing", "index ratio 1"])


@at_every_place
def test_every_block_is_that_of_autograd_through_the_projection(view, place):
    camera, points = view(place)
    project, parameters = _by_parameters(camera, points)
    pixels = project(*parameters)
    assert camera.project(points)[1].all()

    jacobians = camera.project_with_jacobians(points)[1]

    for axis in range(2):
        gradients = torch.autograd.grad(pixels[:, axis].sum(), parameters, retain_graph=True)
        for name, block, gradient in zip(ProjectionJacobians._fields, jacobians, gradients, strict=True):
            size = gradient.abs().amax().clamp(min=1.0)
            assert block.shape == (COUNT, 2, *gradient.shape[1:]), name
            assert_matches(block[:, axis] / size, gradient / size, slack=10.0)


@pytest.mark.parametrize("place", ["water", "land", "nadir", "grazing"])
def test_autograd_through_the_projection_is_right_in_every_parameter(view, place):
    project, parameters = _by_parameters(*view(place))

    assert torch.autograd.gradcheck(project, parameters, rtol=1e-4, atol=1e-4)


def test_autograd_at_index_ratio_one_is_right_in_every_other_parameter(view):
    project, parameters = _by_parameters(*view("index ratio 1"))

    assert torch.autograd.gradcheck(lambda *x: project(*x, parameters[-1].detach()), parameters[:-1], atol=1e-4)


@at_every_place
def test_the_pixels_and_the_mask_are_those_of_project(view, place):
    camera, points = view(place)

    pixels, _, valid = camera.project_with_jacobians(points)

    expected, expected_valid = camera.project(points)
    assert_matches(pixels, expected, slack=10.0)
    assert torch.equal(valid, expected_valid)


def test_a_grid_of_cameras_and_points_gives_a_grid_of_jacobians(make_camera, points_seen):
    cameras = make_camera(3)
    points = points_seen(cameras[0], 5)

    _, grid, _ = cameras[:, None].project_with_jacobians(points)

    _, alone, _ = cameras[2].project_with_jacobians(points)
    for name, block, expected in zip(ProjectionJacobians._fields, grid, alone, strict=True):
        assert block.shape == (3, *expected.shape), name
        assert_matches(block[2], expected, slack=10.0)


def test_entries_that_are_not_valid_are_finite(view):
    camera, points = view("water")
    points[:3] = 2.0 * camera.center_in_world[:3] - points[:3]  # behind the camera
    points[2] = camera.center_in_world[2]
    center = camera.center_in_world.clone()
    center[3:, 2] *= -1.0

    pixels, jacobians, valid = replace(camera, center_in_world=center).project_with_jacobians(points)

    assert not valid.any()
    assert pixels.isfinite().all()
    assert all(block.isfinite().all() for block in jacobians)


def test_gradients_of_valid_points_survive_beside_points_that_are_not(view):
    camera, points = view("water")
    points[0] = 2.0 * camera.center_in_world[0] - points[0]
    points[1] = camera.center_in_world[1]
    points.requires_grad_()

    camera.project(points)[0].sum().backward()

    assert points.grad.isfinite().all()
    assert (points.grad[2:] != 0).all()


def _by_parameters(camera, points):
    """The projection as a function of what `ProjectionJacobians` differentiates in, and where it is evaluated."""

    def project(*parameters):
        turn, center, point, focal, principal_point, distortion, index_ratio = parameters
        lens = replace(camera.intrinsics, focal=focal, principal_point=principal_point, distortion=distortion)
        rotation = so3_exp(turn) @ camera.cam_from_world_rotation
        return RefractiveCamera(lens, rotation, center, FlatInterface(index_ratio)).project(point)[0]

    lens = camera.intrinsics
    values = (
        torch.zeros(3, dtype=torch.float64),
        camera.center_in_world,
        points,
        lens.focal,
        lens.principal_point,
        lens.distortion,
        camera.interface.index_like(points),
    )
    sizes = ((3,), (3,), (3,), (2,), (2,), (5,), ())
    return project, [
        value.expand(COUNT, *size).clone().requires_grad_() for value, size in zip(values, sizes, strict=True)
    ]


def _grazing(camera):
    """Cameras that look 89 degrees away from the nadir, nearly along the water."""
    tilt = torch.tensor(math.radians(89.0), dtype=torch.float64)
    forward = torch.stack((torch.zeros_like(tilt), tilt.sin(), -tilt.cos()))
    right = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward)).expand(COUNT, 3, 3)
    level = replace(camera, cam_from_world_rotation=rotation)
    origins, directions, _ = level.cast_rays(level.intrinsics.principal_point + torch.zeros(COUNT, 2, dtype=tilt.dtype))
    return level, origins + torch.linspace(0.2, 2.0, COUNT, dtype=tilt.dtype)[:, None] * directions
