"""Random subsets for sample consensus."""

from itertools import combinations

import pytest
import torch
from scipy.stats import chisquare

from torchrefrac.ransac.msac import draw_samples


@pytest.mark.parametrize(("num_data", "size"), [(6, 1), (6, 2), (6, 4), (7, 6)])
def test_every_subset_is_equally_likely(generator, num_data, size):
    samples = draw_samples(40_000, num_data, size, generator).sort(dim=-1).values

    subsets = torch.tensor(list(combinations(range(num_data), size)))
    counts = (samples[:, None] == subsets).all(dim=-1).sum(dim=0)
    assert int(counts.sum()) == 40_000
    assert chisquare(counts.numpy()).pvalue > 0.01


@pytest.mark.parametrize(("num_data", "size"), [(4, 4), (5, 4), (30, 7), (100_000, 8)])
def test_a_sample_holds_no_index_twice_and_none_out_of_range(generator, num_data, size):
    samples = draw_samples(5000, num_data, size, generator).sort(dim=-1).values

    assert samples.shape == (5000, size)
    assert samples.dtype == torch.long
    assert (samples[:, 1:] > samples[:, :-1]).all()
    assert samples.min() >= 0
    assert samples.max() < num_data


def test_every_index_gets_its_turn(generator):
    samples = draw_samples(2000, 50, 4, generator)

    assert samples.unique().tolist() == list(range(50))


def test_a_sample_as_large_as_the_data_is_all_of_them(generator):
    samples = draw_samples(100, 5, 5, generator).sort(dim=-1).values

    assert torch.equal(samples, torch.arange(5).expand(100, 5))


def test_the_same_seed_draws_the_same_samples():
    first, second = (draw_samples(100, 40, 4, torch.Generator().manual_seed(7)) for _ in range(2))
    other = draw_samples(100, 40, 4, torch.Generator().manual_seed(8))

    assert torch.equal(first, second)
    assert not torch.equal(first, other)


def test_successive_draws_of_one_generator_differ(generator):
    assert not torch.equal(draw_samples(100, 40, 4, generator), draw_samples(100, 40, 4, generator))


def test_samples_do_not_depend_on_each_other(generator):
    """The subsets of neighbouring samples, as pairs, are uniform too."""
    samples = draw_samples(40_000, 4, 2, generator).sort(dim=-1).values

    subset = 4 * samples[:, 0] + samples[:, 1]
    kinds, subset = subset.unique(return_inverse=True)
    pairs = torch.bincount(len(kinds) * subset[0::2] + subset[1::2], minlength=len(kinds) ** 2)
    assert chisquare(pairs.numpy()).pvalue > 0.01
