"""Linear least squares on the unit circle."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from tests.tolerances import EXACT, assert_matches
from torchrefrac.numerics import least_squares_on_circle


def test_minimum_is_that_of_a_dense_scan_over_the_angle(draw):
    gram, rhs = _problems(draw, 60)

    y = least_squares_on_circle(gram, rhs)

    for g, r, found in zip(gram.numpy(), rhs.numpy(), y.numpy(), strict=True):
        scale = np.abs(g).max() + np.abs(r).max()
        assert _objective(g, r, found) <= _scanned_minimum(g, r) + 1e-13 * scale


def test_result_is_a_unit_vector_where_the_objective_is_stationary(draw):
    gram, rhs = _problems(draw, 5000)

    y = least_squares_on_circle(gram, rhs)

    assert_matches(y.norm(dim=-1), torch.ones(5000, dtype=y.dtype))
    residual = (gram @ y[..., None])[..., 0] - rhs
    tangential = y[:, 0] * residual[:, 1] - y[:, 1] * residual[:, 0]
    assert (tangential.abs() / (gram.norm(dim=(-2, -1)) + rhs.norm(dim=-1))).max() < EXACT.rounding


def test_consistent_equations_are_solved_exactly(draw):
    rows, angle = draw.normal(100, 6, 2), draw.uniform(-np.pi, np.pi, 100)
    truth = torch.stack((angle.cos(), angle.sin()), dim=-1)

    y = least_squares_on_circle(rows.mT @ rows, (rows.mT @ (rows @ truth[..., None]))[..., 0])

    torch.testing.assert_close(y, truth, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("along_weak", [0.0, 1e-300, 1e-100, 1e-30, 1e-15, 1e-12, 1e-9, -1e-9, -1e-15, -1e-30])
def test_the_hard_case_and_its_neighbourhood_take_the_missing_length_from_the_weak_direction(draw, along_weak):
    q = torch.linalg.qr(draw.normal(2, 2)).Q  # columns: the weak and the strong direction
    gram = q @ torch.diag(torch.tensor([1.0, 4.0], dtype=torch.float64)) @ q.mT
    rhs = q @ torch.tensor([along_weak, 1.5], dtype=torch.float64)  # 1.5 / (4 - 1) = 1/2 along the strong direction

    y = q.mT @ least_squares_on_circle(gram, rhs)

    torch.testing.assert_close(y.abs(), torch.tensor([0.75**0.5, 0.5], dtype=y.dtype), rtol=0.0, atol=1e-8)
    assert y[1] > 0


@pytest.mark.parametrize("along_weak", [1e-12, -1e-12, 1e-30, -1e-30])
def test_the_sign_along_the_weak_direction_is_that_of_the_right_hand_side(along_weak):
    gram = torch.diag(torch.tensor([1.0, 4.0], dtype=torch.float64))
    rhs = torch.tensor([along_weak, 1.5], dtype=torch.float64)

    y = least_squares_on_circle(gram, rhs)

    expected = torch.tensor([np.copysign(0.75**0.5, along_weak), 0.5], dtype=torch.float64)
    torch.testing.assert_close(y, expected, rtol=0.0, atol=1e-8)


def test_the_hard_case_is_exact_up_to_its_border():
    strong = torch.tensor([0.9, 0.99, 0.999, 0.9999, 0.999999, 1.0], dtype=torch.float64)
    gram = torch.diag(torch.tensor([1.0, 4.0], dtype=torch.float64)).expand(6, 2, 2)

    y = least_squares_on_circle(gram, torch.stack((torch.zeros(6, dtype=torch.float64), 3.0 * strong), dim=-1))

    torch.testing.assert_close(y[:, 1], strong, rtol=0.0, atol=1e-12)


def test_zero_right_hand_side_gives_the_eigenvector_of_the_smaller_eigenvalue(draw):
    gram, _ = _problems(draw, 100)

    y = least_squares_on_circle(gram, torch.zeros(100, 2, dtype=torch.float64))

    weakest = torch.linalg.eigh(gram).eigenvectors[..., 0]
    torch.testing.assert_close((y * weakest).sum(dim=-1).abs(), torch.ones(100, dtype=y.dtype), rtol=1e-12, atol=0.0)


def test_isotropic_gram_follows_the_right_hand_side():
    y = least_squares_on_circle(7.0 * torch.eye(2, dtype=torch.float64), torch.tensor([-3.0, 4.0], dtype=torch.float64))

    assert_matches(y, torch.tensor([-0.6, 0.8], dtype=y.dtype))


def _problems(draw, count):
    """Gram matrices and right-hand sides over many scales, none of them consistent."""
    rows, values = draw.normal(count, 6, 2), draw.normal(count, 6, 1)
    scale = draw.power_of_ten(-4.0, 4.0, count, 1, 1)
    weight = draw.power_of_ten(-3.0, 3.0, count, 1)
    return rows.mT @ rows * scale, (rows.mT @ values)[..., 0] * scale[..., 0] * weight


def _objective(gram, rhs, y):
    return float(y @ gram @ y - 2.0 * rhs @ y)


def _scanned_minimum(gram, rhs):
    def at(angle):
        return _objective(gram, rhs, np.array([np.cos(angle), np.sin(angle)]))

    angles = np.linspace(-np.pi, np.pi, 721)
    best = angles[np.argmin([at(angle) for angle in angles])]
    step = angles[1] - angles[0]
    return minimize_scalar(at, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-12}).fun
