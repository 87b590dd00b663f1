"""Photographs that look alike, of descriptors that are drawn."""

import pytest
import torch

from torchrefrac.features import Features, MatchOptions, likeness, match
from torchrefrac.features.retrieval import COSINE, FIRST, aggregated, learn_words, nearest_word, share_of_first


def _descriptors(draw, images=30, seen=60, step=12):
    """Image i shows places step i to step i + seen of a row, each with a descriptor, and noise."""
    places = draw.uniform(0.0, 1.0, step * images + seen, 32).float() ** 3
    shown = (places[step * i : step * i + seen] for i in range(images))
    noisy = (one + 0.05 * draw.normal(*one.shape).float() for one in shown)
    return [_features(torch.nn.functional.normalize(one, dim=-1)) for one in noisy]


def _features(descriptors):
    zeros = torch.zeros(len(descriptors), 3)
    return Features(zeros[:, :2].double(), descriptors, zeros.byte(), zeros[:, 0].double())


def test_photographs_that_show_the_same_places_are_the_most_alike(draw):
    score = likeness(_descriptors(draw), 0.8).fill_diagonal_(-torch.inf)

    nearest = score.topk(2, dim=1).indices
    apart = (nearest - torch.arange(30)[:, None]).abs()

    assert score.shape == (30, 30)
    assert int((apart <= 2).sum()) >= 56


def test_a_seed_decides_and_an_empty_photograph_is_like_no_other(draw):
    descriptors = [*_descriptors(draw), _features(torch.zeros(0, 32))]

    score = likeness(descriptors, 0.8, seed=3)

    assert torch.equal(score, likeness(descriptors, 0.8, seed=3))
    assert float(score[-1].abs().max()) == 0.0
    assert torch.equal(score, score.T)


@pytest.mark.parametrize("count", [2, 100, 300])
def test_the_share_of_first_keypoints_is_that_which_matching_finds(draw, count):
    drawn = [one.unit().repeat(5, 1)[:count] + 0.02 * draw.normal(count, 32).float() for one in _descriptors(draw, 4)]
    descriptors = [_features(torch.nn.functional.normalize(one, dim=-1)) for one in drawn]

    found = share_of_first(descriptors, torch.tensor([0, 1]), torch.tensor([1, 3]), 0.9)

    wanted = [match(*(descriptors[i].unit(slice(FIRST)) for i in pair), MatchOptions(0.9)) for pair in ((0, 1), (1, 3))]
    assert (found * FIRST).tolist() == [len(one) for one in wanted]


@pytest.mark.parametrize("count", [0, 1])
def test_photographs_with_next_to_no_descriptors_are_hardly_alike(count):
    score = likeness([_features(torch.nn.functional.normalize(torch.ones(count, 32), dim=-1))] * 3, 0.8)

    assert float(score.abs().max()) <= COSINE * count + count / FIRST


def test_what_is_aggregated_is_that_of_the_definition(draw):
    descriptors = _descriptors(draw)
    words = learn_words(descriptors, 0)
    one = descriptors[4].unit()

    parts = []
    for i, word in enumerate(words):
        near = [row for row in one if int((words - row).norm(dim=1).argmin()) == i]
        total = sum((row - word for row in near), torch.zeros(32))
        parts.append(total / max(float(total.norm()), 1e-12))
    vector = torch.cat(parts)
    vector = vector.sign() * vector.abs().sqrt()

    torch.testing.assert_close(aggregated(one, words), vector / vector.norm(), rtol=1e-3, atol=1e-4)


def test_each_word_is_the_mean_of_what_is_nearest_to_it(draw):
    descriptors = torch.cat([centre + 0.01 * draw.normal(40, 8).float() for centre in torch.eye(8)])

    words = learn_words([_features(descriptors)], 0)

    word = nearest_word(descriptors, words)
    used = word.unique()
    means = torch.stack([descriptors[word == i].mean(dim=0) for i in used])
    assert float((words[used] - means).norm(dim=1).median()) < 0.01
