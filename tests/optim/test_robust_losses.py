"""Robust losses and their weights."""

import math
from typing import get_args

import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.optim import LossName, huber, robust
from torchrefrac.optim.loss import BENDING, LEAST_CURVATURE, radial_curvature, turned

every = pytest.mark.parametrize("loss", get_args(LossName))


@every
def test_the_weight_is_the_derivative(draw, loss):
    s = draw.power_of_ten(-4.0, 4.0, 200).requires_grad_()

    rho, weight = robust(s, loss, 0.7)

    (gradient,) = torch.autograd.grad(rho.sum(), s)
    assert_matches(weight, gradient)


@every
def test_far_below_the_scale_the_loss_is_the_square(draw, loss):
    s = draw.power_of_ten(-12.0, -9.0, 50)

    rho, weight = robust(s, loss, 3.0)

    torch.testing.assert_close(rho, s, rtol=1e-9, atol=0.0)
    torch.testing.assert_close(weight, torch.ones_like(s), rtol=1e-9, atol=0.0)


@every
def test_the_derivative_at_zero_is_one(loss):
    s = torch.zeros(1, dtype=torch.float64, requires_grad=True)

    rho, weight = robust(s, loss, 1.0)

    (gradient,) = torch.autograd.grad(rho.sum(), s)
    assert rho.tolist() == [0.0]
    assert gradient.tolist() == weight.tolist() == [1.0]


@every
def test_the_loss_is_never_more_than_the_square_and_never_falls(draw, loss):
    s = draw.power_of_ten(-4.0, 6.0, 500).sort().values

    rho, weight = robust(s, loss, 0.7)

    assert (rho <= s).all()
    assert (rho.diff() >= 0.0).all()
    assert ((weight >= 0.0) & (weight <= 1.0)).all()
    assert (weight.diff() <= 0.0).all()


@every
def test_the_scale_has_the_unit_of_the_residual(draw, loss):
    s = draw.power_of_ten(-3.0, 3.0, 100)

    rho, weight = robust(s * 1e4, loss, 70.0)

    expected, same = robust(s, loss, 0.7)
    assert_matches(rho / 1e4, expected)
    assert_matches(weight, same)


@pytest.mark.parametrize("loss", ["huber", "cauchy", "truncated"])
def test_the_loss_is_continuous_at_the_scale(loss):
    s = 2.25 * (1.0 + torch.tensor([-1e-12, 1e-12], dtype=torch.float64))

    rho, weight = robust(s, loss, 1.5)

    torch.testing.assert_close(rho[0], rho[1], rtol=1e-11, atol=0.0)
    if loss != "truncated":
        torch.testing.assert_close(weight[0], weight[1], rtol=1e-11, atol=0.0)


@every
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_dtype_and_the_shape_are_kept(loss, dtype):
    for value in robust(torch.ones(2, 3, dtype=dtype), loss, 0.5):
        assert (value.dtype, value.shape) == (dtype, (2, 3))


def test_squared_is_the_square_whatever_its_size(draw):
    s = draw.power_of_ten(-4.0, 12.0, 50)

    rho, weight = robust(s, "squared", 0.1)

    assert torch.equal(rho, s)
    assert (weight == 1.0).all()


def test_huber_is_quadratic_inside_and_linear_outside():
    residual = torch.tensor([0.0, 0.5, 1.9, 2.0, 2.1, 50.0], dtype=torch.float64)

    rho, _ = huber(residual.square(), 2.0)

    assert_matches(rho, torch.where(residual <= 2.0, residual.square(), 2.0 * 2.0 * residual - 4.0))


def test_huber_by_name_is_huber(draw):
    s = draw.power_of_ten(-4.0, 4.0, 50)

    for named, direct in zip(robust(s, "huber", 0.3), huber(s, 0.3), strict=True):
        assert torch.equal(named, direct)


def test_cauchy_grows_with_the_logarithm_far_out():
    s = torch.tensor([1e12, 1e16], dtype=torch.float64)

    rho, weight = robust(s, "cauchy", 2.0)

    assert rho.tolist() == pytest.approx([4.0 * math.log(value / 4.0) for value in s.tolist()], rel=1e-11)
    assert weight.tolist() == pytest.approx([4.0 / value for value in s.tolist()], rel=1e-11)


def test_truncated_takes_no_notice_of_what_lies_beyond_the_scale():
    s = torch.tensor([8.9, 9.0, 9.1, 1e9, math.inf], dtype=torch.float64)

    rho, weight = robust(s, "truncated", 3.0)

    assert rho.tolist() == [8.9, 9.0, 9.0, 9.0, 9.0]
    assert weight.tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]


@every
def test_the_curvature_along_the_residual_is_half_the_second_derivative(draw, loss):
    length = draw.uniform(0.05, 3.0, 100).requires_grad_()
    length = length[((length - 0.7).abs() > 1e-6).nonzero()[:, 0]]

    rho, weight = robust(length.square(), loss, 0.7)

    (slope,) = torch.autograd.grad(rho.sum(), length, create_graph=True)
    (second,) = torch.autograd.grad(slope.sum(), length)
    assert_matches(radial_curvature(weight.detach(), loss), 0.5 * second, slack=10.0)


@pytest.mark.parametrize("loss", BENDING)
def test_turned_residuals_have_the_gradient_and_the_curvature_of_the_loss_as_far_as_that_is_positive(draw, loss):
    residual = draw.uniform(-2.0, 2.0, 2, 200)
    square = residual.square().sum(dim=0)
    _, weight = robust(square, loss, 0.7)

    bend, longer = turned((residual[0], residual[1]), weight, loss)

    turn = torch.eye(2, dtype=torch.float64) - torch.einsum("k, ik, jk -> kij", bend, residual, residual)
    along = residual.T / square.sqrt()[:, None]
    curvature = torch.einsum("ki, kij, kjl, kl -> k", along, turn, turn, along)
    assert_matches(curvature, (radial_curvature(weight, loss) / weight).clamp(min=LEAST_CURVATURE), slack=10.0)
    assert_matches(torch.einsum("kij, kjl, lk, k -> ik", turn, turn, residual, longer), residual, slack=10.0)


@pytest.mark.parametrize("loss", BENDING)
def test_a_residual_of_zero_is_not_turned(loss):
    zero = torch.zeros(3, dtype=torch.float64)

    bend, longer = turned((zero, zero), torch.ones(3, dtype=torch.float64), loss)

    assert bend.tolist() == [0.0] * 3
    assert longer.tolist() == [1.0] * 3
