"""Indexing of batches whose elements have dimensions of their own."""

import pytest
import torch

from torchrefrac.numerics import columns_at, like, pick, thin

BATCH = (4, 3)
INDICES = [
    1,
    -1,
    slice(1, 3),
    (2, 1),
    (slice(None), 0),
    (0, slice(0, 2)),
    ...,
    (..., 1),
    (1, ...),
    (..., None),
    None,
    (None, 1),
    torch.tensor([3, 0, 0]),
    [2, 1],
    (torch.tensor([0, 1]), torch.tensor([2, 2])),
    torch.tensor([True, False, True, True]),
    torch.tensor([[True, False, True]]).expand(4, 3),
    torch.zeros(4, 3, dtype=torch.bool),
]
with_every_index = pytest.mark.parametrize("index", INDICES, ids=str)


@with_every_index
def test_numbers_are_indexed_as_their_batch(draw, index):
    value = draw.normal(*BATCH)

    assert torch.equal(pick(value, index, BATCH), value[index])


@with_every_index
@pytest.mark.parametrize("event", [(5,), (3, 3), (4, 3)])
def test_elements_keep_their_own_dimensions(draw, index, event):
    value = draw.normal(*BATCH, *event)
    places = torch.arange(12).reshape(BATCH)[index]

    picked = pick(value, index, BATCH, len(event))

    assert torch.equal(picked, value.flatten(0, 1)[places.flatten()].reshape(*places.shape, *event))


@with_every_index
@pytest.mark.parametrize("shape", [(3,), (4, 1), (1, 3), (1, 1)])
def test_what_is_not_yet_broadcast_is_picked_as_if_it_were(draw, index, shape):
    value = draw.normal(*shape, 2)

    assert torch.equal(pick(value, index, BATCH, 1), pick(value.expand(*BATCH, 2), index, BATCH, 1))


@with_every_index
def test_what_has_no_batch_belongs_to_every_element(draw, index):
    matrix = draw.normal(3, 3)

    assert pick(matrix, index, BATCH, 2) is matrix
    assert pick(1.333, index, BATCH) == 1.333
    assert pick(None, index, BATCH) is None


def test_the_gradient_reaches_what_was_picked(draw):
    value = draw.normal(4, 1, 2).requires_grad_()

    pick(value, (1, ...), BATCH, 1).sum().backward()

    expected = torch.zeros(4, 1, 2, dtype=torch.float64)
    expected[1] = 3.0
    assert torch.equal(value.grad, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numbers_and_tensors_take_the_dtype_of_what_they_stand_beside(dtype):
    reference = torch.zeros(2, dtype=dtype)

    for value in (1.333, 1, torch.tensor(1.333), torch.tensor([1.333], dtype=torch.float64)):
        assert like(value, reference).dtype == dtype
    assert like(reference, reference) is reference


def test_thinning_keeps_both_ends_and_spreads_the_rest_evenly():
    assert thin(torch.arange(10, 21), 3).tolist() == [10, 15, 20]


@pytest.mark.parametrize("count", [5, 6])
def test_few_rows_are_not_thinned(count):
    assert thin(torch.arange(5), count).tolist() == [0, 1, 2, 3, 4]


def test_columns_of_a_table_are_those_asked_for(draw, generator):
    table, index = draw.normal(3, 7), torch.randint(0, 7, (20,), generator=generator)

    assert torch.equal(columns_at(table, index), table[:, index])
