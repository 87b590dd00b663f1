"""Exponential coordinates of rotations."""

import math

import pytest
import torch

from tests.tolerances import DTYPES, EXACT, assert_matches
from torchrefrac.geometry import nearest_rotation, rotate, skew, so3_exp, so3_log

# Around the switch to the series at 1e-4, and up to half a turn.
ANGLES = [0.0, 1e-15, 1e-8, 0.99e-4, 1.01e-4, 1e-2, 1.0, 3.0, math.pi - 1e-5, math.pi - 1e-9]


def test_skew_is_the_cross_product(draw):
    v, w = draw.normal(2, 5, 3), draw.normal(2, 5, 3)

    assert_matches(rotate(skew(v), w), torch.linalg.cross(v, w))


def test_rotate_broadcasts_a_batch_of_rotations_against_points(draw):
    rotations, points = draw.rotations(4), draw.normal(4, 6, 3)

    rotated = rotate(rotations[:, None], points)

    assert_matches(rotated, torch.einsum("bij,bnj->bni", rotations, points))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(draw, angle, dtype):
    omega = draw.directions(50) * angle

    expected = torch.linalg.matrix_exp(skew(omega)).to(dtype)

    assert_matches(so3_exp(omega.to(dtype)), expected)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(draw, angle):
    omega = draw.directions(50) * angle

    torch.testing.assert_close(so3_log(so3_exp(omega)), omega, rtol=EXACT.rounding, atol=1e-15)


def test_exp_inverts_log_for_any_rotation(draw):
    rotation = draw.rotations(3, 200)

    assert_matches(so3_exp(so3_log(rotation)), rotation)


def test_half_a_turn_comes_back_about_its_axis_up_to_sign(draw):
    axis = torch.cat((draw.directions(50), torch.eye(3, dtype=torch.float64)))

    omega = so3_log(2.0 * axis[:, :, None] * axis[:, None, :] - torch.eye(3, dtype=torch.float64))

    sign = (omega * axis).sum(dim=-1, keepdim=True).sign()
    torch.testing.assert_close(sign * omega, math.pi * axis, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 0.5e-4, 2e-4, 1.0])
def test_exp_has_the_right_derivatives(draw, angle):
    omega = (draw.directions(3) * angle).requires_grad_()

    assert torch.autograd.gradcheck(so3_exp, omega)


def test_the_derivative_of_exp_at_zero_is_the_generator():
    derivative = torch.autograd.functional.jacobian(so3_exp, torch.zeros(3, dtype=torch.float64))

    assert_matches(derivative.movedim(-1, 0), skew(torch.eye(3, dtype=torch.float64)))


def test_the_nearest_rotation_is_the_one_that_a_search_cannot_improve(draw):
    matrix = draw.rotations(20) + 0.3 * draw.normal(20, 3, 3)
    matrix[::4] = matrix[::4] @ torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))  # reflections, too

    nearest = nearest_rotation(matrix)

    torch.testing.assert_close(nearest @ nearest.mT, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))
    assert (torch.linalg.det(nearest) > 0.0).all()
    off = (nearest - matrix).square().sum(dim=(1, 2))
    for size in (2.0, 0.3, 0.01):
        other = so3_exp(size * draw.normal(500, 1, 3)) @ nearest
        assert ((other - matrix).square().sum(dim=(2, 3)) >= off - 1e-12).all()


def test_a_rotation_is_its_own_nearest(draw):
    rotation = draw.rotations(5)

    torch.testing.assert_close(nearest_rotation(rotation), rotation)
