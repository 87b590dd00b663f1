"""Mutual nearest neighbours that pass the ratio test."""

import math

import pytest
import torch

from torchrefrac.features import MatchOptions, match, matching, rough_products
from torchrefrac.features.rough_products import BYTES, HALF, SINGLE, RoughDescriptors, nearest_of

KINDS = [BYTES, HALF, SINGLE]


@pytest.fixture(params=KINDS, ids=lambda kind: str(kind.values))
def kind(request, monkeypatch):
    """What descriptors are rounded to, on any processor."""
    monkeypatch.setattr(rough_products, "_fastest", lambda device: request.param)
    return request.param


@pytest.fixture
def descriptors(draw):
    """Two sets of unit descriptors; the first 40 of 60 reappear among the 70 of the other, in disorder and noisy."""
    first = torch.nn.functional.normalize(draw.uniform(0.0, 1.0, 60, 16), dim=-1)
    second = torch.nn.functional.normalize(draw.uniform(0.0, 1.0, 70, 16), dim=-1)
    second[torch.arange(69, 29, -1)] = torch.nn.functional.normalize(first[:40] + 0.1 * draw.normal(40, 16), dim=-1)
    return first, second


@pytest.mark.parametrize("ratio", [0.6, 0.8, 0.95])
def test_matches_are_those_of_the_definition(descriptors, ratio, kind):
    first, second = descriptors
    distance = torch.cdist(first, second)
    expected = []
    for row, line in enumerate(distance):
        order = line.argsort()
        mutual = int(distance[:, order[0]].argmin()) == row
        if mutual and line[order[0]] < ratio * line[order[1]]:
            expected.append([row, int(order[0])])

    found = match(first, second, MatchOptions(ratio))

    assert 0 < len(expected) < 60
    assert found.tolist() == expected


def test_descriptors_that_reappear_are_found(descriptors):
    found = match(*descriptors, MatchOptions())

    assert len(found) > 10
    assert (found.sum(dim=1) == 69).double().mean() > 0.8


@pytest.mark.parametrize("chunk", [1, 7, 60])
def test_the_size_of_chunks_changes_nothing(descriptors, monkeypatch, kind, chunk):
    whole = match(*descriptors, MatchOptions())

    monkeypatch.setattr(matching, "AT_ONCE", chunk)
    monkeypatch.setattr(rough_products, "_fastest", lambda device: kind._replace(rows=chunk, columns=256))

    assert torch.equal(match(*descriptors, MatchOptions()), whole)


def test_of_two_equal_descriptors_the_first_is_matched(kind):
    one = torch.eye(4)

    found = match(torch.cat((one[:2], one)), one, MatchOptions())

    assert found.tolist() == [[0, 0], [1, 1], [4, 2], [5, 3]]


def test_a_descriptor_with_two_equal_partners_has_none(kind):
    one = torch.eye(4)
    twice = torch.cat((one, one[:1]))

    assert match(one, twice, MatchOptions()).tolist() == [[1, 1], [2, 2], [3, 3]]


def test_of_two_descriptors_with_one_partner_the_nearer_has_it(kind):
    angle = torch.tensor([0.3, 0.1, 0.2])
    first = torch.stack((angle.cos(), angle.sin()), dim=-1)
    second = torch.tensor([[1.0, 0.0], [math.cos(2.0), math.sin(2.0)]])

    assert match(first, second, MatchOptions()).tolist() == [[1, 0]]


@pytest.mark.parametrize(("first", "second"), [(0, 5), (5, 0), (0, 0), (5, 1)])
def test_without_a_nearest_and_a_second_nearest_there_are_no_matches(first, second):
    found = match(torch.ones(first, 8), torch.ones(second, 8), MatchOptions())

    assert found.shape == (0, 2)
    assert found.dtype == torch.long


@pytest.mark.parametrize(("first", "second"), [(3, 2), (40, 129), (700, 1030), (513, 2300)])
def test_ties_and_any_sizes_are_matched_as_a_look_at_the_whole_matrix_says(draw, first, second, kind):
    """Descriptors of few whole numbers, of which many are equal: their products are exact, however they are summed."""
    descriptors = [draw.uniform(0.0, 3.0, count, 6).round().float() / 8.0 for count in (first, second)]

    found = match(*descriptors, MatchOptions(1.0))

    similarity = descriptors[0] @ descriptors[1].T
    two = similarity.topk(2, dim=1)
    distance = (2.0 - 2.0 * two.values).clamp(min=0.0)
    first_best = similarity.max(dim=0).indices  # of equal ones the first
    target = two.indices[:, 0]
    mutual = (first_best[target] == torch.arange(first)) & (distance[:, 0] < distance[:, 1])
    assert found.tolist() == torch.stack((torch.arange(first), target), dim=-1)[mutual].tolist()


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("size", [6, 128])
def test_rough_products_err_by_no_more_than_they_state(draw, kind, size, signed):
    one, other = (
        torch.nn.functional.normalize(draw.uniform(-1.0 if signed else 0.0, 1.0, count, size).float() ** 3, dim=1)
        for count in (300, 1100)
    )

    found = nearest_of(RoughDescriptors.of(one), RoughDescriptors.of(other))

    exact = one.double() @ other.double().T
    two = exact.topk(2, dim=1).values
    assert ((found.largest - two[:, 0]).abs() < found.error).all()
    assert ((found.second - two[:, 1]).abs() < found.error).all()
    assert torch.equal(found.target[found.is_certain], exact.argmax(dim=1)[found.is_certain])
    assert found.error.max() < (0.03 if kind is BYTES else 0.002)


def test_descriptors_of_zeros_match_nothing(kind):
    assert len(match(torch.zeros(5, 8), torch.zeros(7, 8), MatchOptions())) == 0
