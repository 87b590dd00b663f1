"""Photographs that look alike, of descriptors that are drawn."""

import torch

from torchrefrac.features import likeness
from torchrefrac.features.retrieval import aggregated, learn_words, nearest_word


def _descriptors(draw, images=30, seen=60, step=12):
    """Image i shows places step i to step i + seen of a row, each with a descriptor, and noise."""
    places = draw.uniform(0.0, 1.0, step * images + seen, 32).float() ** 3
    shown = (places[step * i : step * i + seen] for i in range(images))
    noisy = (one + 0.05 * draw.normal(*one.shape).float() for one in shown)
    return [torch.nn.functional.normalize(one, dim=-1) for one in noisy]


def test_photographs_that_show_the_same_places_are_the_most_alike(draw):
    score = likeness(_descriptors(draw)).fill_diagonal_(-torch.inf)

    nearest = score.topk(2, dim=1).indices
    apart = (nearest - torch.arange(30)[:, None]).abs()

    assert score.shape == (30, 30)
    assert int((apart <= 2).sum()) >= 56


def test_a_seed_decides_and_an_empty_photograph_is_like_no_other(draw):
    descriptors = [*_descriptors(draw), torch.zeros(0, 32)]

    score = likeness(descriptors, seed=3)

    assert torch.equal(score, likeness(descriptors, seed=3))
    assert float(score[-1].abs().max()) == 0.0
    torch.testing.assert_close(score.diagonal()[:-1], torch.ones(30))


def test_photographs_without_any_descriptor_are_alike_in_nothing():
    assert torch.equal(likeness([torch.zeros(0, 32)] * 3), torch.zeros(3, 3))


def test_what_is_aggregated_is_that_of_the_definition(draw):
    descriptors = _descriptors(draw)
    words = learn_words(descriptors, 0)
    one = descriptors[4]

    parts = []
    for i, word in enumerate(words):
        near = [row for row in one if int((words - row).norm(dim=1).argmin()) == i]
        total = sum((row - word for row in near), torch.zeros(32))
        parts.append(total / max(float(total.norm()), 1e-12))
    vector = torch.cat(parts)
    vector = vector.sign() * vector.abs().sqrt()

    torch.testing.assert_close(aggregated(one, words), vector / vector.norm(), rtol=1e-3, atol=1e-4)


def test_each_word_is_the_mean_of_what_is_nearest_to_it(draw):
    descriptors = [torch.cat([centre + 0.01 * draw.normal(40, 8).float() for centre in torch.eye(8)])]

    words = learn_words(descriptors, 0)

    word = nearest_word(descriptors[0], words)
    used = word.unique()
    means = torch.stack([descriptors[0][word == i].mean(dim=0) for i in used])
    assert float((words[used] - means).norm(dim=1).median()) < 0.01
