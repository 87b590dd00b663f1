"""A random order without a table."""

import pytest
import torch

from torchrefrac.numerics import permuted


@pytest.mark.parametrize("count", [1, 2, 3, 16, 17, 1000, 4097])
def test_every_number_is_met_once(count):
    numbers = torch.arange(count)

    assert permuted(numbers, count, 3).sort().values.tolist() == list(range(count))


def test_a_part_is_where_the_whole_puts_it():
    whole = permuted(torch.arange(1000), 1000, 5)

    assert torch.equal(permuted(torch.tensor([7, 900, 7]), 1000, 5), whole[[7, 900, 7]])


def test_orders_of_other_seeds_are_others_and_look_random():
    one, other = (permuted(torch.arange(10_000), 10_000, seed) for seed in (0, 1))

    assert (one == other).double().mean() < 0.002
    for order in (one, other):
        assert abs(torch.corrcoef(torch.stack((torch.arange(10_000.0), order.float())))[0, 1]) < 0.04
        assert abs(torch.corrcoef(torch.stack((order[:-1].float(), order[1:].float())))[0, 1]) < 0.04
        bins = torch.bincount(order[:5000] // 100, minlength=100)  # of the first half half lies in each hundredth
        assert int(bins.min()) > 20
        assert int(bins.max()) < 80


def test_counts_beyond_memory_are_ordered_too():
    found = permuted(torch.arange(1000), 10**13, 2)

    assert len(found.unique()) == 1000
    assert (found >= 0).all()
    assert (found < 10**13).all()
    assert (found > 5 * 10**12).double().mean() == pytest.approx(0.5, abs=0.1)


def test_no_numbers_are_no_numbers():
    assert permuted(torch.zeros(0, dtype=torch.long), 0, 1).tolist() == []


@pytest.mark.parametrize("number", [-1, 10])
def test_numbers_beyond_the_count_are_refused(number):
    with pytest.raises(ValueError, match=r"must be 0 to 9$"):
        permuted(torch.tensor([number]), 10, 0)
