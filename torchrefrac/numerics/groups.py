"""Which things hang together, and which are the same."""

import numpy as np
import torch
from jaxtyping import Int, Shaped
from torch import Tensor


def components(first: Int[Tensor, " e"], second: Int[Tensor, " e"], count: int) -> Int[Tensor, " {count}"]:
    """The connected component, numbered from 0, of each of `count` nodes; edge i joins first[i] and second[i]."""
    from scipy.sparse import coo_array  # noqa: PLC0415 - slow to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    ends = first.cpu().numpy(), second.cpu().numpy()
    graph = coo_array((np.ones(len(first), dtype=np.int8), ends), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return torch.from_numpy(label.astype(np.int64)).to(first.device)


def joined(first: Int[Tensor, " e"], second: Int[Tensor, " e"]) -> tuple[Int[Tensor, " f"], Int[Tensor, " f"]]:
    """As few edges as join what these edges join: each node but one of every component with the one."""
    nodes, ends = torch.unique(torch.cat((first, second)), return_inverse=True)
    root = first_of_each(components(ends[: len(first)], ends[len(first) :], len(nodes)))
    inner = (root != torch.arange(len(nodes), device=root.device)).nonzero()[:, 0]
    return nodes[inner], nodes[root[inner]]


def first_of_each(group: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """For each of n things the first one of its group, groups being numbered from 0."""
    ids = torch.arange(len(group), device=group.device)
    first = torch.full((int(group.max()) + 1 if len(group) else 0,), len(group), device=group.device)
    return first.scatter_reduce(0, group, ids, reduce="amin")[group]


def first_equal(rows: Shaped[Tensor, "n k"]) -> Int[Tensor, " n"]:
    """For each row the first one that is equal to it."""
    return first_of_each(torch.unique(rows, dim=0, return_inverse=True)[1])


def equal_before(rows: Shaped[Tensor, "n k"]) -> Int[Tensor, " n"]:
    """For each row how many of those before it are equal to it."""
    group = torch.unique(rows, dim=0, return_inverse=True)[1]
    order = group.argsort(stable=True)
    return torch.empty_like(group).scatter_(0, order, counted_in_runs(torch.bincount(group)))


def counted_in_runs(length: Int[Tensor, " r"]) -> Int[Tensor, " n"]:
    """0, 1, 2 and so on in each of r runs of these lengths, one run after the other."""
    first = length.cumsum(dim=0) - length
    return torch.arange(int(length.sum()), device=length.device) - first.repeat_interleave(length)
