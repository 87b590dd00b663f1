"""The inverse of the Gauss-Newton matrix as an operator, against the matrix itself."""

from dataclasses import replace

import pytest
import torch

from tests.optim.linear_problems import with_gauge
from torchrefrac.optim import Covariance, GaussNewtonInverse, SingularError

SHAPES = [
    {},
    {"families": [(3, 2)]},
    {"families": [(1, 2), (2, 1)], "extra": 4},
    {"points": 20, "pairs": 75, "families": [(2, 2)]},
    {"cameras": 9, "points": 20, "pairs": 90},
]
PORTIONS = [(64, 1 << 19), (4, 2 * 4 * 3 * 6 * 4)]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=str)


@pytest.fixture(params=PORTIONS, ids=lambda portion: f"tile{portion[0]}-elements{portion[1]}")
def portions(request, cut):
    cut(*request.param, cached=11)
    return request.param


def often_seen(linear, at_least=2):
    """The same without the points that fewer cameras see."""
    seen = torch.bincount(linear.point, minlength=linear.num_eliminated) >= at_least
    where = linear.where(seen[linear.point])
    return replace(where, point=(torch.cumsum(seen, dim=0) - 1)[where.point], num_eliminated=int(seen.sum()))


def matrix_of(operator, size):
    """Of a linear function of vectors (size)."""
    return torch.stack([operator(unit) for unit in torch.eye(size, dtype=torch.float64)], dim=1)


def close(actual, expected, slack=1e-8):
    torch.testing.assert_close(actual, expected, rtol=0.0, atol=slack * float(expected.abs().max()))


@shapes
def test_it_is_the_inverse_of_the_whole_matrix(make_linear, portions, shape):
    linear = often_seen(make_linear(**shape))
    hessian, _ = linear.dense()

    inverse = GaussNewtonInverse.of(linear.system())

    found = matrix_of(inverse, len(hessian))
    close(hessian @ found, torch.eye(len(hessian), dtype=torch.float64))
    close(found, found.T)


@shapes
def test_with_a_gauge_it_is_that_of_the_matrix_and_the_stiffness_along_the_gauge(make_linear, portions, draw, shape):
    linear, null_space = with_gauge(often_seen(make_linear(**{**shape, "extra": 0})), draw)
    hessian, _ = linear.dense()

    inverse = GaussNewtonInverse.of(linear.system(null_space))

    found, added = (matrix_of(f, len(hessian)) for f in (inverse, inverse.gauge_times))
    close((hessian + added) @ found, torch.eye(len(hessian), dtype=torch.float64))
    close(found, found.T)


def test_the_stiffness_is_along_the_gauge_and_nowhere_else(make_linear, draw):
    linear, null_space = with_gauge(often_seen(make_linear()), draw)

    inverse = GaussNewtonInverse.of(linear.system(null_space))

    added = matrix_of(inverse.gauge_times, linear.size + 3 * linear.num_eliminated)
    projector = torch.zeros_like(added)
    projector[: linear.size, : linear.size] = null_space @ null_space.T
    close(added, float(inverse.stiffness) * projector)
    assert inverse.stiffness > 0.0


def test_without_a_gauge_nothing_is_added(make_linear, draw):
    linear = often_seen(make_linear())
    vector = draw.normal(linear.size + 3 * linear.num_eliminated)

    added = GaussNewtonInverse.of(linear.system()).gauge_times(vector)

    assert torch.equal(added, torch.zeros_like(vector))


@pytest.mark.parametrize("gauge", [False, True])
def test_cameras_and_points_without_observations_stand_still_and_move_nothing(make_linear, draw, gauge):
    linear, null_space = with_gauge(often_seen(make_linear()), draw)
    linear = often_seen(linear.where(linear.camera != 2))
    linear = replace(linear, num_eliminated=linear.num_eliminated + 1)
    idle = torch.zeros(linear.size + 3 * linear.num_eliminated, dtype=torch.bool)
    idle[12:18] = idle[-3:] = True
    if not gauge:
        linear, null_space = replace(linear, by_reduced=draw.normal(*linear.by_reduced.shape)), None

    inverse = GaussNewtonInverse.of(linear.system(null_space))

    found = matrix_of(inverse, len(idle))
    assert (found[idle] == 0.0).all()
    assert (found[:, idle] == 0.0).all()
    matrix = (linear.dense()[0] + matrix_of(inverse.gauge_times, len(idle)))[~idle][:, ~idle]
    close(matrix @ found[~idle][:, ~idle], torch.eye(len(matrix), dtype=torch.float64))


@pytest.mark.parametrize("known", [0, 3])
def test_a_matrix_that_is_singular_beyond_its_gauge_raises(make_linear, draw, known):
    for _ in range(10):  # rounding decides what a Cholesky factorisation makes of a zero
        linear, null_space = with_gauge(often_seen(make_linear()), draw)

        with pytest.raises(SingularError, match="the normal equations are singular"):
            GaussNewtonInverse.of(linear.system(null_space[:, :known] if known else None))


@shapes
@pytest.mark.parametrize("gauge", [False, True])
def test_deviations_of_combinations_are_those_of_the_covariance(make_linear, draw, shape, gauge):
    linear, null_space = with_gauge(often_seen(make_linear(**{**shape, "extra": 0})), draw)
    system = linear.system(null_space) if gauge else often_seen(make_linear(**shape)).system()
    directions = draw.normal(system.plan.size, 3)

    inverse, covariance = GaussNewtonInverse.of(system), Covariance.of(system).reduced

    close(inverse.covariance_times(directions), covariance @ directions)
    close(inverse.deviations(directions).square(), (directions.T @ covariance @ directions).diagonal())
    close(inverse.deviations_of([4, 1]).square(), covariance.diagonal()[[4, 1]])
