"""Noise of keypoints, point by point: against scalar root finding, and what known distributions of it demand."""

import math

import pytest
import torch
from scipy.optimize import brentq
from scipy.special import digamma, polygamma

from torchrefrac.bundle.point_noise import point_variances


def _drawn(draw, points, observations, deviation):
    """Squared residuals of points that are drawn with deviations of their own, whose unknowns take three numbers."""
    point = torch.arange(points).repeat_interleave(observations)
    residual = deviation[:, None] * draw.normal(points, 2 * observations - 3)
    square = torch.zeros(points, observations, dtype=torch.float64)
    square[:, 0] = residual.square().sum(dim=1)
    return square.flatten(), point


def test_points_that_are_alike_get_nearly_one_variance(draw):
    square, point = _drawn(draw, 2000, 4, torch.full((2000,), 0.3, dtype=torch.float64))

    found = point_variances(square, point, 2000, 0.0)

    assert float(found.mean().sqrt()) == pytest.approx(0.3, rel=0.03)
    assert float(found.std() / found.mean()) < 0.1


def test_variances_are_those_of_the_distribution_that_fits_all_points(draw):
    """The oracle solves the two equations of Smyth (2004), section 6.2, one number at a time."""
    nu, typical, observations = 5.0, 0.2, 4
    chi = torch.distributions.Chi2(torch.tensor(nu, dtype=torch.float64))
    torch.manual_seed(5)
    deviation = typical * (nu / chi.sample((3000,))).sqrt()
    square, point = _drawn(draw, 3000, observations, deviation)

    found = point_variances(square, point, 3000, 0.0)

    freedom = 2 * observations - 3
    own = square.view(3000, observations).sum(dim=1) / freedom
    level = own.log().numpy()
    excess = level.var() - polygamma(1, freedom / 2)
    half = brentq(lambda x: polygamma(1, x) - excess, 1e-3, 1e3)
    scale = math.exp(level.mean() - digamma(freedom / 2) + math.log(freedom / 2) + digamma(half)) / half
    expected = (freedom * own + 2.0 * half * scale) / (freedom + 2.0 * half - 2.0)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0.0)
    assert 2.0 * half == pytest.approx(nu, rel=0.25)


def test_errors_over_these_deviations_have_variance_one_although_tails_are_heavy(draw):
    chi = torch.distributions.Chi2(torch.tensor(4.0, dtype=torch.float64))
    torch.manual_seed(6)
    deviation = 0.1 * (4.0 / chi.sample((20000,))).sqrt()
    square, point = _drawn(draw, 20000, 3, deviation)

    found = point_variances(square, point, 20000, 0.0)

    error = deviation * draw.normal(20000)
    assert float((error.square() / found).mean().sqrt()) == pytest.approx(1.0, abs=0.06)


def test_unknowns_that_points_share_take_their_part(draw):
    square, point = _drawn(draw, 500, 6, torch.full((500,), 1.0, dtype=torch.float64))

    none, fifth = (float(point_variances(square, point, 500, share).mean()) for share in (0.0, 0.2))

    assert fifth / none == pytest.approx((12.0 - 3.0) / (12.0 * 0.8 - 3.0), rel=0.1)


@pytest.mark.parametrize("count", [1, 19])
def test_a_few_points_share_one_variance(draw, count):
    square, point = _drawn(draw, count, 5, torch.full((count,), 0.5, dtype=torch.float64))

    found = point_variances(square, point, count, 0.0)

    torch.testing.assert_close(found, square.sum().expand(count) / (7 * count))


def test_points_without_observations_or_residuals_have_finite_variances():
    square, point = torch.zeros(60, dtype=torch.float64), torch.arange(30).repeat_interleave(2)

    assert point_variances(square, point, 31, 0.0).isfinite().all()
