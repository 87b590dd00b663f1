"""Rotations near a measured vertical."""

import math

import pytest
import torch
from torch import Tensor

from tests.tolerances import DTYPES, TOLERANCE, assert_matches
from torchrefrac.geometry import heading_rotation, level_rotation, so3_log
from torchrefrac.refinement import tilt_and_heading, tilted_rotation
from torchrefrac.refinement.tilt import turn_by_tilt

DEGREES = [0.0, 1e-6, 0.1, 2.0, 30.0, 80.0, 150.0]


@pytest.fixture
def make_tilts(draw):
    """`make_tilts(degrees, count=20)`: tilts (count, 2) of that angle about any horizontal axis, headings (count)."""

    def make(degrees: float, count: int = 20) -> tuple[Tensor, Tensor]:
        axis = draw.uniform(-math.pi, math.pi, count)
        tilt = math.radians(degrees) * torch.stack((axis.cos(), axis.sin()), dim=-1)
        return tilt, draw.uniform(-math.pi, math.pi, count)

    return make


@pytest.fixture
def cam_from_level(draw) -> Tensor:
    return draw.rotations(20)


@pytest.mark.parametrize("degrees", DEGREES)
def test_the_rotation_is_heading_then_tilt_then_the_measured_vertical(make_tilts, cam_from_level, degrees):
    tilt, heading = make_tilts(degrees)

    rotation = tilted_rotation(cam_from_level, tilt, heading)

    about = torch.cat((tilt, torch.zeros_like(tilt[:, :1])), dim=-1)
    expected = cam_from_level @ torch.linalg.matrix_exp(_cross(about)) @ heading_rotation(heading)
    assert_matches(rotation, expected)


@pytest.mark.parametrize("degrees", DEGREES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_tilt_and_heading_come_back_from_the_rotation(make_tilts, cam_from_level, dtype, degrees):
    tilt, heading = (value.to(dtype) for value in make_tilts(degrees))
    level = cam_from_level.to(dtype)

    found, turned = tilt_and_heading(level, tilted_rotation(level, tilt, heading))

    tolerance = 10.0 * TOLERANCE[dtype].rounding
    torch.testing.assert_close(found, tilt, rtol=tolerance, atol=tolerance)
    difference = turned - heading
    assert torch.atan2(difference.sin(), difference.cos()).abs().max() < tolerance


def test_any_rotation_comes_back_from_its_tilt_and_heading(draw):
    level, rotation = draw.rotations(50), draw.rotations(50)

    assert_matches(tilted_rotation(level, *tilt_and_heading(level, rotation)), rotation, slack=10.0)


def test_the_tilt_is_the_angle_between_measured_and_true_vertical(draw):
    down = draw.directions(20)
    measured = torch.nn.functional.normalize(down + 0.05 * draw.directions(20), dim=-1)
    rotation = level_rotation(down) @ heading_rotation(draw.uniform(-3.0, 3.0, 20))

    tilt, _ = tilt_and_heading(level_rotation(measured), rotation)

    angle = torch.atan2(torch.linalg.cross(down, measured).norm(dim=-1), (down * measured).sum(dim=-1))
    torch.testing.assert_close(tilt.norm(dim=-1), angle, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize("degrees", DEGREES)
def test_the_turn_is_the_finite_difference_of_the_rotation(make_tilts, cam_from_level, degrees):
    tilt, heading = make_tilts(degrees)
    rotation = tilted_rotation(cam_from_level, tilt, heading)

    turn = turn_by_tilt(tilt, heading)

    step = 1e-5
    for k, (by_tilt, by_heading) in enumerate((((step, 0.0), 0.0), ((0.0, step), 0.0), ((0.0, 0.0), step))):
        change = tilt.new_tensor(by_tilt)
        ahead, behind = (
            so3_log(rotation.mT @ tilted_rotation(cam_from_level, tilt + s * change, heading + s * by_heading))
            for s in (1.0, -1.0)
        )
        torch.testing.assert_close(turn[..., k], (ahead - behind) / (2.0 * step), rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("degrees", DEGREES)
def test_the_turn_is_the_derivative_by_autograd(make_tilts, cam_from_level, degrees):
    tilt, heading = make_tilts(degrees)
    rotation = tilted_rotation(cam_from_level, tilt, heading)

    by_tilt, by_heading = torch.autograd.functional.jacobian(
        lambda t, h: tilted_rotation(cam_from_level, t, h).sum(dim=0), (tilt, heading)
    )

    derivative = torch.cat((by_tilt.movedim(2, 0), by_heading.movedim(2, 0)[..., None]), dim=-1)
    spin = rotation.mT[..., None, :, :] @ derivative.movedim(-1, 1)
    vector = 0.5 * torch.stack(
        (spin[..., 2, 1] - spin[..., 1, 2], spin[..., 0, 2] - spin[..., 2, 0], spin[..., 1, 0] - spin[..., 0, 1]), -1
    )
    assert_matches(turn_by_tilt(tilt, heading), vector.mT, slack=100.0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_without_tilt_the_gradients_are_finite_and_right(cam_from_level, dtype):
    level = cam_from_level.to(dtype)
    tilt = torch.zeros(20, 2, dtype=dtype, requires_grad=True)

    (gradient,) = torch.autograd.grad(tilted_rotation(level, tilt, tilt.new_zeros(20))[..., 2].sum(), tilt)

    assert_matches(gradient, torch.stack((-level[..., 1].sum(dim=-1), level[..., 0].sum(dim=-1)), dim=-1))
    assert torch.equal(turn_by_tilt(tilt.detach(), tilt.new_zeros(20)), torch.eye(3, dtype=dtype).expand(20, 3, 3))


def test_second_derivatives_without_tilt_are_finite(cam_from_level):
    def sine(tilt):
        return tilted_rotation(cam_from_level[0], tilt, tilt.new_zeros(()))[..., 0, 0]

    hessian = torch.func.hessian(sine)(torch.zeros(2, dtype=torch.float64))

    assert hessian.isfinite().all()


def test_leading_dimensions_broadcast(draw):
    level, tilt, heading = draw.rotations(2), 0.1 * draw.normal(5, 2, 2), draw.normal(5, 1)

    rotation = tilted_rotation(level, tilt, heading)

    assert rotation.shape == (5, 2, 3, 3)
    assert_matches(rotation[3, 1], tilted_rotation(level[1], tilt[3, 1], heading[3, 0]))


def _cross(v: Tensor) -> Tensor:
    return torch.linalg.cross(v[..., None, :].expand(*v.shape, 3), torch.eye(3, dtype=v.dtype).expand(*v.shape, 3)).mT
