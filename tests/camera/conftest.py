"""Cameras above water, and points that they see."""

import math

import pytest
import torch

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.refraction import FlatInterface

DISTORTION = (-0.12, 0.06, 0.002, -0.003, -0.01)


@pytest.fixture
def lens():
    """A thousand pixels wide, 60 degrees across, with a clearly visible distortion of every kind."""
    return Intrinsics.create(1000, 800, (900.0, 910.0), (510.0, 390.0), DISTORTION)


@pytest.fixture
def make_camera(draw, lens):
    """`make_camera(*shape)`: cameras one to three above the water, tilted by up to 40 degrees, in any heading."""

    def make(*shape, intrinsics=lens, index_ratio=1.333, max_tilt_deg=40.0):
        tilt, heading = draw.uniform(0.0, math.radians(max_tilt_deg), *shape), draw.uniform(-3.0, 3.0, *shape)
        roll = draw.uniform(-3.0, 3.0, *shape)
        down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
        rotation = _turn(roll, 0, 1) @ _turn(tilt, 1, 2) @ down @ _turn(heading, 0, 1)
        center = torch.cat((draw.uniform(-5.0, 5.0, *shape, 2), draw.uniform(1.0, 3.0, *shape, 1)), dim=-1)
        return RefractiveCamera(intrinsics, rotation, center, FlatInterface(index_ratio))

    return make


@pytest.fixture
def make_pixels(draw):
    """`make_pixels(*shape)`: pixels (*shape, 2) all over the image of `lens`."""

    def make(*shape):
        return torch.cat((draw.uniform(0.0, 1000.0, *shape, 1), draw.uniform(0.0, 800.0, *shape, 1)), dim=-1)

    return make


@pytest.fixture
def points_seen(draw, make_pixels):
    """`points_seen(camera, *shape, land=False)`: a point for each camera, 0.1 to 2 under water or 0.1 to 0.5 above."""

    def make(camera, *shape, land=False):
        viewing = camera.view_directions(make_pixels(*shape))
        if land:
            origin, direction, rise = camera.center_in_world, viewing, draw.uniform(0.1, 0.5, *shape)
        else:
            origin, direction, _ = camera.cast_rays(make_pixels(*shape))
            rise = -draw.uniform(0.1, 2.0, *shape)
        return origin + ((rise - origin[..., 2]) / direction[..., 2])[..., None] * direction

    return make


def _turn(angle, i, j):
    """Rotation matrices by `angle` in the plane of the axes i and j."""
    matrix = torch.eye(3, dtype=angle.dtype).repeat(*angle.shape, 1, 1)
    matrix[..., i, i], matrix[..., i, j] = angle.cos(), -angle.sin()
    matrix[..., j, i], matrix[..., j, j] = angle.sin(), angle.cos()
    return matrix
