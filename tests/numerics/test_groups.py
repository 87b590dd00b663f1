"""What hangs together, and what is the same."""

import torch

from torchrefrac.numerics import components, counted_in_runs, equal_before, first_equal, first_of_each, joined


def test_nodes_hang_together_along_edges_in_both_directions_and_lone_ones_by_themselves():
    label = components(torch.tensor([0, 3, 4]), torch.tensor([3, 5, 1]), 7)

    groups = {frozenset((label == value).nonzero()[:, 0].tolist()) for value in label.unique()}
    assert groups == {frozenset({0, 3, 5}), frozenset({1, 4}), frozenset({2}), frozenset({6})}
    assert sorted(label.unique().tolist()) == [0, 1, 2, 3]


def test_without_edges_every_node_is_alone():
    none = torch.zeros(0, dtype=torch.long)
    assert components(none, none, 3).tolist() == [0, 1, 2]
    assert components(none, none, 0).tolist() == []


def test_few_edges_join_what_many_do(generator):
    first, second = torch.randint(0, 300, (2, 180), generator=generator) * 7

    few = joined(first, second)

    assert torch.equal(components(*few, 2100), components(first, second, 2100))
    nodes, parts = len(torch.cat((first, second)).unique()), len(components(first, second, 2100).unique())
    assert len(few[0]) == nodes - (parts - (2100 - nodes))


def test_no_edges_join_nothing():
    none = torch.zeros(0, dtype=torch.long)

    assert [len(ends) for ends in joined(none, none)] == [0, 0]


def test_the_first_of_each_group_stands_for_it():
    assert first_of_each(torch.tensor([1, 0, 1, 2, 0])).tolist() == [0, 1, 0, 3, 1]
    assert first_of_each(torch.zeros(0, dtype=torch.long)).tolist() == []


def test_equal_rows_are_found_whatever_lies_between(draw):
    rows = draw.normal(5, 2)[torch.tensor([2, 4, 2, 0, 4, 1])]
    assert first_equal(rows).tolist() == [0, 1, 0, 3, 1, 5]
    assert equal_before(rows).tolist() == [0, 0, 1, 0, 1, 0]
    assert equal_before(rows[:0]).tolist() == []


def test_each_run_is_counted_from_nought():
    assert counted_in_runs(torch.tensor([3, 0, 1, 2])).tolist() == [0, 1, 2, 0, 0, 1]
    assert counted_in_runs(torch.zeros(0, dtype=torch.long)).tolist() == []
