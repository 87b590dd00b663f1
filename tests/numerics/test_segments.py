"""Sums over groups of rows and of columns."""

import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.numerics import segment_sum, segment_sum_columns


def test_rows_of_one_segment_are_added_and_absent_segments_are_zero():
    values = torch.arange(12.0).reshape(4, 3)

    total = segment_sum(values, torch.tensor([2, 0, 2, 4]), 5)

    expected = torch.zeros(5, 3)
    expected[0], expected[2], expected[4] = values[1], values[0] + values[2], values[3]
    assert torch.equal(total, expected)


def test_trailing_dimensions_of_the_rows_are_kept(draw):
    values = draw.normal(6, 2, 3)

    total = segment_sum(values, torch.tensor([0, 1, 0, 1, 0, 1]), 2)

    assert_matches(total, torch.stack((values[::2].sum(0), values[1::2].sum(0))))


def test_no_rows_at_all_sum_to_zero():
    assert torch.equal(segment_sum(torch.empty(0, 2), torch.empty(0, dtype=torch.long), 3), torch.zeros(3, 2))


def test_the_gradient_of_a_row_is_that_of_its_segment(draw):
    values, weights = draw.normal(4, 2).requires_grad_(), draw.normal(3, 2)
    segment = torch.tensor([1, 1, 0, 2])

    (segment_sum(values, segment, 3) * weights).sum().backward()

    assert torch.equal(values.grad, weights[segment])


def test_columns_of_one_segment_are_added_and_absent_segments_are_zero():
    values = torch.arange(12.0).reshape(3, 4)

    total = segment_sum_columns(values, torch.tensor([2, 0, 2, 4]), 5)

    expected = torch.zeros(3, 5)
    expected[:, 0], expected[:, 2], expected[:, 4] = values[:, 1], values[:, 0] + values[:, 2], values[:, 3]
    assert torch.equal(total, expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_sums_of_columns_are_sums_of_rows_of_the_transpose(draw, generator, dtype):
    values = draw.normal(6, 500).to(dtype)
    segment = torch.randint(0, 40, (500,), generator=generator)

    total = segment_sum_columns(values, segment, 41)

    assert total.dtype == dtype
    assert_matches(total, segment_sum(values.T, segment, 41).T)


def test_no_columns_at_all_sum_to_zero():
    total = segment_sum_columns(torch.empty(2, 0), torch.empty(0, dtype=torch.long), 3)

    assert torch.equal(total, torch.zeros(2, 3))


def test_the_gradient_of_a_column_is_that_of_its_segment(draw):
    values, weights = draw.normal(2, 4).requires_grad_(), draw.normal(2, 3)
    segment = torch.tensor([1, 1, 0, 2])

    (segment_sum_columns(values, segment, 3) * weights).sum().backward()

    assert torch.equal(values.grad, weights[:, segment])
