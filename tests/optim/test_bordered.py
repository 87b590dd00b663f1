"""Factors of matrices that end in blocks of their own, against dense ones."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.optim import Covariance, GaussNewtonInverse, Linearized, normal_equations
from torchrefrac.optim.bordered import BorderedFactor


@pytest.fixture
def matrix_of(draw):
    """`matrix_of(first, count)`: a positive definite matrix that ends in so many blocks of three."""

    def make(first, count):
        alone = torch.block_diag(*(draw.normal(3, 3) for _ in range(count)), torch.zeros(0, 0)).double()
        rows = torch.cat((draw.normal(len(alone), first), alone), dim=1)
        return rows.T @ rows + torch.eye(first + 3 * count, dtype=torch.float64)

    return make


@pytest.mark.parametrize(("first", "count"), [(7, 0), (7, 1), (5, 6), (0, 4)])
def test_it_solves_and_inverts_as_the_whole_matrix_does(matrix_of, draw, first, count):
    matrix, right = matrix_of(first, count), draw.normal(first + 3 * count, 2)

    factor = BorderedFactor.of(matrix.tril(), count)

    assert bool(factor.found)
    torch.testing.assert_close(factor.solve(right), torch.linalg.solve(matrix, right))
    torch.testing.assert_close(factor.inverse(), torch.linalg.inv(matrix))
    torch.testing.assert_close(factor.diagonal().prod().square(), torch.linalg.det(matrix))


@pytest.mark.parametrize("at", [0, 10])
def test_what_is_not_positive_definite_has_none(matrix_of, at):
    matrix = matrix_of(5, 3)
    matrix[at, at] = -1.0

    assert not bool(BorderedFactor.of(matrix, 3).found)


@pytest.fixture
def points_on_their_own(make_linear):
    """A problem whose last unknowns are two blocks, each of which meets cameras but not the other."""
    linear = make_linear(extra=6, pairs=55)
    (term,) = linear.terms
    own = torch.arange(len(term.columns)) % 2 * 3
    last = linear.size - 6 + own[:, None] + torch.arange(3)
    columns = torch.cat((term.columns[:, :4], last), dim=1)
    return replace(linear, terms=(replace(term, columns=columns, jacobian=term.jacobian[..., :7]),))


def test_steps_and_covariances_are_the_same_where_blocks_are_alone(points_on_their_own, monkeypatch):
    whole = points_on_their_own.system()
    assert whole.lone_blocks == 0
    step, covariance = Linearized(whole, "dense").solve(1e-3), Covariance.of(whole)
    monkeypatch.setattr(normal_equations, "MANY_LONE", 2)
    system = points_on_their_own.system()

    assert system.lone_blocks == 2
    found = Linearized(system, "dense").solve(1e-3)
    assert bool(found.solved)
    torch.testing.assert_close(found.reduced, step.reduced)
    torch.testing.assert_close(found.eliminated, step.eliminated)
    torch.testing.assert_close(Covariance.of(system).reduced, covariance.reduced)
    assert len(GaussNewtonInverse.of(system).factor.cholesky.blocks) == 2


def test_blocks_that_have_a_term_in_common_are_not_alone(make_linear, monkeypatch):
    monkeypatch.setattr(normal_equations, "MANY_LONE", 2)

    assert make_linear(extra=6).system().lone_blocks == 0
