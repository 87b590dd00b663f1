"""Robust losses and their weights."""

import torch
from tolerances import assert_matches

from torchrefrac.optim import huber


def test_huber_is_quadratic_inside_and_linear_outside():
    residual = torch.tensor([0.0, 0.5, 1.9, 2.0, 2.1, 50.0], dtype=torch.float64)

    rho, _ = huber(residual.square(), 2.0)

    expected = torch.where(residual <= 2.0, residual.square(), 2.0 * 2.0 * residual - 4.0)
    assert_matches(rho, expected)


def test_the_weight_of_huber_is_its_derivative(draw):
    s = draw.power_of_ten(-4.0, 4.0, 200).requires_grad_()

    rho, weight = huber(s, 0.7)

    (gradient,) = torch.autograd.grad(rho.sum(), s)
    assert_matches(weight, gradient)


def test_huber_and_its_weight_are_continuous_at_the_scale():
    s = torch.tensor([2.25 * (1.0 - 1e-12), 2.25 * (1.0 + 1e-12)], dtype=torch.float64)

    for value in huber(s, 1.5):
        torch.testing.assert_close(value[0], value[1], rtol=1e-11, atol=0.0)


def test_huber_has_a_finite_derivative_at_zero():
    s = torch.zeros(1, dtype=torch.float64, requires_grad=True)

    huber(s, 1.0)[0].sum().backward()

    assert s.grad.tolist() == [1.0]
