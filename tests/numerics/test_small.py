"""Closed forms for 2x2 and 3x3 symmetric matrices."""

import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.numerics import inverse_cholesky_3x3, inverse_cholesky_components, smallest_eigenvector_2x2

ROW, COLUMN = torch.tril_indices(3, 3)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
def test_inverse_cholesky_is_the_inverse_of_the_cholesky_factor(draw, batch, dtype):
    factor = draw.normal(*batch, 3, 5)
    matrix = (factor @ factor.mT + torch.eye(3, dtype=torch.float64)).to(dtype)

    x = inverse_cholesky_3x3(matrix)

    expected = torch.linalg.inv(torch.linalg.cholesky(matrix.double())).to(dtype)
    assert_matches(x, expected)


def test_inverse_cholesky_whitens_ill_conditioned_matrices_to_condition_times_epsilon(draw):
    condition = draw.power_of_ten(0.0, 12.0, 500)
    q, middle = draw.rotations(500), draw.uniform(0.0, 1.0, 500)
    spectrum = torch.stack((torch.ones_like(condition), condition**-middle, condition.reciprocal()), dim=-1)
    matrix = q @ torch.diag_embed(spectrum) @ q.mT

    x = inverse_cholesky_3x3(matrix)

    error = (x @ matrix @ x.mT - torch.eye(3, dtype=torch.float64)).abs().amax(dim=(-2, -1))
    assert (error / condition).max() < 10.0 * torch.finfo(torch.float64).eps


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_inverse_cholesky_of_a_singular_matrix_is_finite(draw, rank):
    factor = draw.normal(500, 3, rank)

    assert inverse_cholesky_3x3(factor @ factor.mT).isfinite().all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
def test_inverse_cholesky_by_components_is_that_of_the_matrices(draw, batch, dtype):
    factor = draw.normal(*batch, 3, 5)
    matrix = (factor @ factor.mT + torch.eye(3, dtype=torch.float64)).to(dtype)

    x = inverse_cholesky_components(matrix[..., ROW, COLUMN].unbind(dim=-1))

    expected = torch.linalg.inv(torch.linalg.cholesky(matrix.double())).to(dtype)
    assert_matches(torch.stack(x, dim=-1), expected[..., ROW, COLUMN])


@pytest.mark.parametrize("dtype", DTYPES)
def test_inverse_cholesky_by_components_of_zeros_maps_zero_to_zero(dtype):
    """What nothing is known of stays where it is."""
    x = inverse_cholesky_components([torch.zeros(4, dtype=dtype)] * 6)

    assert all(part.isfinite().all() for part in x)
    assert (torch.stack(x) * 0.0 == 0.0).all()


def test_inverse_cholesky_reads_the_lower_triangle_alone(draw):
    factor = draw.normal(20, 3, 5)
    matrix = factor @ factor.mT
    lower = matrix.clone()
    lower[..., COLUMN[ROW > COLUMN], ROW[ROW > COLUMN]] = torch.nan

    assert torch.equal(inverse_cholesky_3x3(lower), inverse_cholesky_3x3(matrix))


def test_smallest_eigenvector_is_that_of_eigh(draw):
    factor = draw.normal(3, 50, 2, 2) * draw.power_of_ten(-6.0, 6.0, 3, 50, 1, 1)
    matrix = factor + factor.mT  # eigenvalues of either sign

    vector = smallest_eigenvector_2x2(matrix)

    expected = torch.linalg.eigh(matrix).eigenvectors[..., 0]
    sign = (vector * expected).sum(dim=-1, keepdim=True).sign()
    torch.testing.assert_close(sign * vector, expected, rtol=0.0, atol=1e-12)


def test_smallest_eigenvector_of_a_multiple_of_the_identity_is_the_second_axis():
    vector = smallest_eigenvector_2x2(3.0 * torch.eye(2, dtype=torch.float64))

    assert_matches(vector, torch.tensor([0.0, 1.0], dtype=torch.float64))
