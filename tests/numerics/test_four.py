"""Determinants and adjugates of 4x4 matrices, the batch last."""

import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.numerics import adjugate_4x4, determinant_4x4


@pytest.fixture
def make_matrices(draw):
    """`make_matrices(*shape, rank=4)`: (4, 4, *shape)."""

    def make(*shape, rank=4):
        product = draw.normal(*shape, 4, rank) @ draw.normal(*shape, rank, 4)
        return product.movedim((-2, -1), (0, 1)).contiguous()

    return make


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", [(), (7,), (2, 3), (0,)])
def test_the_determinant_is_that_of_linalg(make_matrices, batch, dtype):
    matrix = make_matrices(*batch)

    found = determinant_4x4(matrix.to(dtype))

    expected = torch.linalg.det(matrix.movedim((0, 1), (-2, -1)))
    assert found.shape == batch
    assert_matches(found, expected.to(dtype), slack=10.0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", [(), (7,), (2, 3), (0,)])
def test_the_adjugate_is_the_inverse_times_the_determinant(make_matrices, batch, dtype):
    matrix = make_matrices(*batch)

    found = adjugate_4x4(matrix.to(dtype))

    last = matrix.movedim((0, 1), (-2, -1))
    expected = torch.linalg.inv(last) * torch.linalg.det(last)[..., None, None]
    assert_matches(found, expected.movedim((-2, -1), (0, 1)).to(dtype), slack=10.0)


def test_a_matrix_times_its_adjugate_is_the_determinant_on_the_diagonal(make_matrices):
    matrix = make_matrices(1000)

    product = torch.einsum("ijb,jkb->ikb", matrix, adjugate_4x4(matrix))

    expected = torch.eye(4, dtype=torch.float64)[..., None] * determinant_4x4(matrix)
    torch.testing.assert_close(product, expected, rtol=0.0, atol=1e-11)


def test_at_rank_three_every_column_of_the_adjugate_is_a_multiple_of_the_null_vector(make_matrices):
    matrix = make_matrices(1000, rank=3)

    adjugate = adjugate_4x4(matrix)

    null = torch.linalg.svd(matrix.movedim((0, 1), (-2, -1))).Vh[:, -1].T[:, None]
    along = (null * adjugate).sum(dim=0)
    assert (adjugate.norm(dim=(0, 1)) > 1e-3).all()
    torch.testing.assert_close(adjugate, null * along, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_at_a_lower_rank_the_adjugate_vanishes(make_matrices, rank):
    adjugate = adjugate_4x4(make_matrices(1000, rank=rank))

    torch.testing.assert_close(adjugate, torch.zeros_like(adjugate), rtol=0.0, atol=1e-12)
