"""Pairs by the order of names and by scores."""

from itertools import combinations

import pytest
import torch

from torchrefrac.features.pairs import (
    best_partners,
    connected,
    every_pair,
    in_sequence,
    natural_order,
    pairs_of,
    show_order,
)


def test_every_pair_is_listed_once_in_the_order_of_combinations():
    assert [tuple(pair) for pair in pairs_of(every_pair(7)).tolist()] == list(combinations(range(7), 2))


def test_numbers_in_names_count_as_numbers():
    names = ["b/IMG_2.jpg", "IMG_10.jpg", "IMG_9.jpg", "b/IMG_010.jpg", "a1.jpg"]

    assert [names[i] for i in natural_order(names)] == [
        "a1.jpg", "b/IMG_2.jpg", "b/IMG_010.jpg", "IMG_9.jpg", "IMG_10.jpg",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("names", "ordered"),
    [
        ([f"DJI_{i:04d}.JPG" for i in range(3, 40)], True),
        ([f"frame_{5 * i}.png" for i in range(12)], True),
        ([f"a/IMG_{i}.jpg" for i in range(10)] + [f"b/IMG_{i}.jpg" for i in range(10)], True),
        ([f"IMG_{i * i}.jpg" for i in range(20)], False),
        (["left.jpg", "right.jpg", "top.jpg"], False),
        (["only.jpg"], False),
        ([], False),
    ],
)
def test_names_show_an_order_where_most_are_numbered_one_after_the_other(names, ordered):
    assert show_order(names) is ordered


def test_neighbours_in_the_order_of_names_and_those_a_power_of_two_apart_are_pairs(generator):
    order = torch.randperm(30, generator=generator).tolist()
    names = [f"{order[i]}.jpg" for i in range(30)]

    found = in_sequence(names, 3)

    for i in range(30):
        for j in range(30):
            assert bool(found[i, j]) == (abs(order[i] - order[j]) in (1, 2, 3, 4, 8, 16))


def test_the_best_partners_of_either_image_are_pairs():
    score = torch.tensor([
        [9.0, 5.0, 1.0, 0.0],
        [5.0, 9.0, 2.0, -1.0],
        [1.0, 2.0, 9.0, -torch.inf],
        [0.0, -1.0, -torch.inf, 9.0],
    ])  # fmt: skip

    assert pairs_of(best_partners(score, 1)).tolist() == [[0, 1], [0, 3], [1, 2]]
    assert pairs_of(best_partners(score, 1, above=0.0)).tolist() == [[0, 1], [1, 2]]
    assert pairs_of(best_partners(score, 50)).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3]]


def test_images_are_joined_by_the_best_bridges_and_by_no_more():
    chosen = torch.zeros(6, 6, dtype=torch.bool)
    for i, j in ((0, 1), (1, 2), (3, 4)):
        chosen[i, j] = chosen[j, i] = True
    score = -(torch.arange(6.0)[:, None] - torch.tensor([0.0, 1.0, 2.0, 3.5, 4.0, 9.0])).abs()
    score = torch.minimum(score, score.T)

    found = connected(chosen, score)

    assert pairs_of(found & ~chosen).tolist() == [[2, 3], [4, 5]]
    assert torch.equal(found, found.T)
    assert torch.equal(connected(found, -score), found)
