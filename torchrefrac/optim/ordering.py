"""In which order the reduced unknowns are taken where each block meets few others, as in a flight.

Blocks that meet in a tile or in a term are neighbours in a graph. The levels of a breadth-first search from a block at
its periphery (George and Liu, "An implementation of a pseudoperipheral node finder", 1979), of which each meets but the
one before and the one after it, are the sections of a block tridiagonal matrix. What meets more than its neighbours do
comes last, as a border: the shared unknowns, those that no eliminated block meets, blocks that meet many times as many
others as most do, and where there is a null space as many blocks as its directions, which hold it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchrefrac.optim.normal_equations import NormalEquations
from torchrefrac.optim.plan import REDUCED_SIZE

SMALLEST_SECTION = 96
CROWDED = (8.0, 4.0, 2.0)
SWEEPS = 3
Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Clusters:
    """A block diagonal matrix of the reduced blocks: of as many neighbours each, but for the last, which is filled up.

    position: of every reduced unknown, -1 where it is of no block; width: unknowns of each of `count` clusters, one
    after the other.
    """

    position: Int[Tensor, " size"]
    width: int
    count: int

    @classmethod
    def of(cls, system: NormalEquations, blocks: int) -> "Clusters":
        """Of so many blocks each."""
        m, nothing = system.plan.num_reduced, np.zeros(0, dtype=np.int64)
        order = np.concatenate(_levels(system.pairs.cpu().numpy(), nothing, m)) if blocks > 1 else np.arange(m)
        own = REDUCED_SIZE * np.argsort(order)[:, None] + np.arange(REDUCED_SIZE)
        position = np.concatenate((own.flatten(), np.full(system.plan.size - own.size, -1)))
        together = min(blocks, max(m, 1))
        return cls(torch.from_numpy(position).to(system.rows.device), REDUCED_SIZE * together, -(-m // together))

    @property
    def elements(self) -> int:
        """How many numbers the matrix has."""
        return self.count * self.width**2

    def address(self, one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"]) -> Int[Tensor, "*k"]:
        """Of elements below the diagonal."""
        return torch.maximum(one, other) * self.width + torch.minimum(one, other) % self.width

    def has(self, one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"]) -> Bool[Tensor, "*k"]:
        """Those of one cluster."""
        return torch.div(one, self.width, rounding_mode="floor") == torch.div(other, self.width, rounding_mode="floor")


class Section(NamedTuple):
    """own: its unknowns, in the order of elimination; after: how many of the next section there are; first: where its
    panel begins in the numbers of the matrix."""

    own: slice
    after: int
    first: int

    @property
    def size(self) -> int:
        return self.own.stop - self.own.start


@dataclass(frozen=True)
class BandedOrder:
    """position: of every reduced unknown. sizes: of the sections, in unknowns. multipliers: how many unknowns more
    there are between sections and border, one a direction of the null space.

    The numbers of the matrix are panels, one for each section, and a corner. A panel has a column for each unknown of
    its section and rows for these, for those of the next section, for the multipliers and for the border; the corner is
    square, of multipliers and border.
    """

    position: Int[Tensor, " size"]
    sizes: tuple[int, ...]
    multipliers: int = 0

    @classmethod
    def of(cls, system: NormalEquations) -> "BandedOrder":
        """The cheapest one that is found."""
        m, null_space = system.plan.num_reduced, system.null_space
        pairs, anchors = system.pairs.cpu().numpy(), _anchors(null_space, m)
        degree = np.bincount(pairs.flatten(), minlength=m)
        usual = max(float(np.median(degree)), 1.0)
        crowds = {tuple(np.nonzero(degree > factor * usual)[0]) for factor in (np.inf, *CROWDED)}
        orders: list[BandedOrder] = []
        for crowd in crowds:
            border = np.union1d(anchors, np.array(crowd, dtype=np.int64))
            orders.append(cls._of_levels(_levels(pairs, border, m), border, system))
        return min(orders, key=lambda order: order.flops)

    @classmethod
    def _of_levels(cls, levels: Sequence[Ids], border: Ids, system: NormalEquations) -> "BandedOrder":
        size, like = system.plan.size, system.plan.reduced
        blocks = np.concatenate((*levels, border)).astype(np.int64)
        unknowns = (REDUCED_SIZE * blocks[:, None] + np.arange(REDUCED_SIZE)).flatten()
        order = np.concatenate((unknowns, np.arange(len(unknowns), size)))
        multipliers = 0 if system.null_space is None else system.null_space.shape[1]
        inner = REDUCED_SIZE * (len(blocks) - len(border))
        position = np.empty(size, dtype=np.int64)
        position[order] = np.arange(size)
        position[position >= inner] += multipliers
        sizes = tuple(REDUCED_SIZE * len(level) for level in levels)
        return cls(torch.from_numpy(position).to(like.device), sizes, multipliers)

    @property
    def inner(self) -> int:
        """How many unknowns the sections have."""
        return sum(self.sizes)

    @property
    def border(self) -> int:
        """How many multipliers and unknowns of the border there are."""
        return len(self.position) + self.multipliers - self.inner

    @cached_property
    def sections(self) -> tuple[Section, ...]:
        found: list[Section] = []
        start = first = 0
        for size, after in zip(self.sizes, (*self.sizes[1:], 0), strict=True):
            found.append(Section(slice(start, start + size), after, first))
            start, first = start + size, first + size * (size + after + self.border)
        return tuple(found)

    @property
    def elements(self) -> int:
        """How many numbers the matrix has."""
        return sum(s.size * (s.size + s.after + self.border) for s in self.sections) + self.border**2

    @cached_property
    def flops(self) -> float:
        """Of a factorisation."""
        rows = [(s.size, s.after + self.border) for s in self.sections]
        return sum(n**3 / 3 + n**2 * more + n * more**2 for n, more in rows) + self.border**3 / 3

    def address(self, one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"]) -> Int[Tensor, "*k"]:
        """Where the element of two positions is found among the numbers of the matrix, of which those below its
        diagonal are there; the two are of one section, of two that follow each other, or one is of the border."""
        row, column = torch.maximum(one, other), torch.minimum(one, other)
        section, tables = torch.bucketize(column, self._ends, right=True), self._tables
        start, size, first, after = tables[section].unbind(dim=-1)
        row = torch.where(row >= self.inner, row - self.inner + after, row - start)
        return first + row * size + column - start

    def has(self, one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"]) -> Bool[Tensor, "*k"]:
        """Everything that meets."""
        return torch.ones_like(one + other, dtype=torch.bool)

    def panels(self, numbers: Float[Tensor, " elements"]) -> Iterator[tuple[Section, Float[Tensor, "rows section"]]]:
        """The panels of the matrix that has these numbers."""
        for section in self.sections:
            rows = section.size + section.after + self.border
            panel = numbers[section.first : section.first + rows * section.size]
            yield section, panel.view(rows, section.size)

    def corner(self, numbers: Float[Tensor, " elements"]) -> Float[Tensor, "border border"]:
        """Of multipliers and border."""
        return numbers[self.elements - self.border**2 :].view(self.border, self.border)

    def below(self, section: Section, vectors: Float[Tensor, "all k"]) -> Float[Tensor, "rows k"]:
        """The part of vectors, in the order of elimination, that the rows below the diagonal block of a panel are."""
        return torch.cat((vectors[section.own.stop : section.own.stop + section.after], vectors[self.inner :]))

    @cached_property
    def _ends(self) -> Int[Tensor, " sections"]:
        return torch.tensor([s.own.stop for s in self.sections], device=self.position.device, dtype=torch.long)

    @cached_property
    def _tables(self) -> Int[Tensor, "sections 4"]:
        """Of each section, and of the corner: its first position, its size, where its numbers begin, and in which row
        those of multipliers and border begin."""
        lines = [(s.own.start, s.size, s.first, s.size + s.after) for s in self.sections]
        lines.append((self.inner, self.border, self.elements - self.border**2, 0))
        return torch.tensor(lines, device=self.position.device)


def _anchors(null_space: Float[Tensor, "size directions"] | None, num_reduced: int) -> Ids:
    """Blocks that cannot all stand still where something moves along the null space, one a direction at most."""
    if null_space is None:
        return np.zeros(0, dtype=np.int64)
    left, chosen = null_space[: REDUCED_SIZE * num_reduced].cpu().numpy().copy(), set[int]()
    for _ in range(left.shape[1] if len(left) else 0):
        most = int(np.square(left).sum(axis=1).argmax())
        along = left[most] / max(np.linalg.norm(left[most]), np.finfo(left.dtype).tiny)
        left -= np.outer(left @ along, along)
        chosen.add(most // REDUCED_SIZE)
    return np.array(sorted(chosen), dtype=np.int64)


def _levels(pairs: Ids, border: Ids, count: int) -> list[Ids]:
    """All blocks but those of the border; each level meets but the one before and the one after it."""
    from scipy.sparse import coo_array  # noqa: PLC0415 - slow to import
    from scipy.sparse.csgraph import connected_components, dijkstra  # noqa: PLC0415

    inner = np.setdiff1d(np.arange(count), border)
    row, column = pairs[~np.isin(pairs, border).any(axis=1)].T
    graph = coo_array((np.ones(len(row), dtype=np.int8), (row, column)), shape=(count, count)).tocsr()
    degree = np.bincount(np.concatenate((row, column)), minlength=count)[inner]
    part = connected_components(graph, directed=False)[1][inner]
    starts = inner[np.unique(part, return_index=True)[1]]
    level = np.zeros(len(inner), dtype=np.int64)
    for _ in range(SWEEPS if len(inner) else 0):
        steps = dijkstra(graph, directed=False, indices=starts, unweighted=True, min_only=True)[inner]
        level = part * count + steps.astype(np.int64)
        outward = np.lexsort((-degree, level))
        starts = inner[outward[np.append(np.diff(part[outward]) != 0, True)]]
    order = np.argsort(level, kind="stable")
    ends = np.append(np.nonzero(np.diff(level[order]))[0] + 1, len(order))
    return np.split(inner[order], _far_enough(ends.tolist(), SMALLEST_SECTION // REDUCED_SIZE))


def _far_enough(ends: Sequence[int], apart: int) -> list[int]:
    """Those of the ends that are as far from the one before, but for the last."""
    chosen = [0]
    for end in ends[:-1]:
        if end - chosen[-1] >= apart:
            chosen.append(end)
    return chosen[1:]
