"""Which matches look right before any pose is known."""

import pytest
import torch

from torchrefrac.ransac.coherence import LOOKED_AT, are_coherent


@pytest.fixture
def make_places(draw):
    """`make_places(right, wrong)`: places in two images, turned and stretched, of right matches and of others."""

    def make(right, wrong):
        first = draw.uniform(-0.5, 0.5, right + wrong, 2)
        second = first @ first.new_tensor(((0.6, 1.1), (-0.8, 0.5))) + 0.03 * draw.normal(len(first), 2)
        order = torch.cat((torch.arange(right), right + torch.randperm(wrong, generator=draw.generator)))
        return first, second[order]

    return make


@pytest.mark.parametrize(("right", "wrong"), [(20, 0), (20, 20), (30, 70), (60, 240), (1000, 3000)])
def test_right_matches_among_wrong_ones_share_neighbours(make_places, right, wrong):
    assert all(are_coherent(*make_places(right, wrong)) for _ in range(10))


@pytest.mark.parametrize("wrong", [20, 60, 300, 2 * LOOKED_AT])
def test_wrong_matches_seldom_share_more_neighbours_than_by_chance(make_places, wrong):
    assert sum(are_coherent(*make_places(0, wrong)) for _ in range(40)) <= 12


def test_places_that_are_crowded_share_none_for_that(make_places, draw):
    """Half of the keypoints of each image, whichever they are, lie in a corner, where all are near each other."""

    def crowded():
        first, second = (
            torch.where(draw.uniform(0.0, 1.0, 200, 1) < 0.5, 0.01 * places, places) for places in make_places(0, 200)
        )
        return first, second

    assert sum(are_coherent(*crowded()) for _ in range(40)) <= 12


def test_too_few_to_have_neighbours_may_be_right(make_places):
    assert are_coherent(*make_places(0, 6))


def test_the_same_matches_get_the_same_answer_whatever_chance_did_before(make_places):
    places = make_places(12, 88)

    assert len({(torch.manual_seed(seed), are_coherent(*places))[1] for seed in range(5)}) == 1
