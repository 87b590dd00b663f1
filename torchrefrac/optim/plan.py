"""The structure of a problem before any number is known: which blocks meet, in which order, in which tiles.

The order is chosen for the Schur complement. Eliminated blocks that meet the same reduced blocks lie side by side and
are cut into tiles of `TILE`; what a tile adds to the reduced system is one small dense matrix product over the few
reduced blocks that it meets. Tiles that meet as many lie side by side, so that they can be multiplied as a batch.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Int, Shaped
from torch import Tensor

TILE = 64
REDUCED_SIZE = 6
ELIMINATED_SIZE = 3
CHUNK_ELEMENTS = 1 << 19
CHUNK_GROWTH = 1.15
GRAM_ROWS = 64
CACHED = 16384
Ids = Int[Tensor, " observations"]


class Family(NamedTuple):
    """`size` unknowns that come in `count` copies, of which every reduced block depends on one: `member`."""

    size: int
    member: Int[Tensor, " blocks"]
    count: int = 1  # pyright: ignore[reportIncompatibleMethodOverride]


class RowLayout(NamedTuple):
    """Where the numbers of a row are found: the derivatives of a residual in its reduced block, in its member of each
    family and in its eliminated block; then the residual itself. reduced: block and families together."""

    block: slice
    shared: tuple[slice, ...]
    reduced: slice
    eliminated: slice
    residual: slice

    @classmethod
    def of(cls, *family_sizes: int) -> "RowLayout":
        ends = [REDUCED_SIZE]
        for size in (*family_sizes, ELIMINATED_SIZE, 1):
            ends.append(ends[-1] + size)
        block, *shared, eliminated, residual = map(slice, (0, *ends), ends)
        return cls(block, tuple(shared), slice(eliminated.start), eliminated, residual)

    @property
    def size(self) -> int:
        """How many numbers a row has."""
        return self.residual.stop


class Chunk(NamedTuple):
    """Consecutive tiles, multiplied together.

    tiles, observations: the first and the end of each. reduced: the reduced blocks that each tile meets, ascending,
    filled up with their number. slot: where the first row of each observation goes in a buffer of
    (tiles * TILE * 3, width) blocks.
    """

    tiles: slice
    observations: slice
    reduced: Int[Tensor, "tiles width"]
    slot: Ids


class GramRows(NamedTuple):
    """Observations of one reduced block in rows of GRAM_ROWS, counted within their stretch of CACHED and filled up with
    CACHED; which block each row is of; and how many rows there are up to the end of each stretch."""

    table: Int[Tensor, "rows gram"]
    owner: Int[Tensor, " rows"]
    ends: list[int]


@dataclass(frozen=True)
class SchurPlan:
    """The structure of the normal equations; everything in `order`, an arrangement of the observations given.

    reduced, place: the blocks of each observation, the eliminated one by its place among `num_places` (tiles are filled
    up); place_of: that of each eliminated block. The reduced unknowns are 6 of each reduced block, those of the
    families, and `num_extra` more that no eliminated block meets; columns: where those that the observations of a
    reduced block depend on are found among them.
    """

    order: Ids
    reduced: Ids
    place: Ids
    place_of: Int[Tensor, " eliminated"]
    num_reduced: int
    num_places: int
    families: tuple[Family, ...]
    num_extra: int
    columns: Int[Tensor, "blocks width"]
    chunks: tuple[Chunk, ...]

    @classmethod
    def create(
        cls,
        reduced: Ids,
        eliminated: Ids,
        num_reduced: int,
        num_eliminated: int,
        families: Sequence[Family] = (),
        num_extra: int = 0,
        locality: Shaped[Tensor, " eliminated"] | None = None,
    ) -> "SchurPlan":
        """Plan for observations of pairs of a `reduced` and an `eliminated` block, in any order, no pair twice.

        locality: eliminated blocks of near values meet the same reduced ones (a place on a curve that fills space); by
        default the mean of their ids.
        """
        tiling = _Tiling.of(reduced, eliminated, num_reduced, num_eliminated, locality)
        place = tiling.place_of[eliminated]
        pair, order = torch.sort(place * num_reduced + reduced)
        if bool((pair[1:] == pair[:-1]).any()):
            raise ValueError("two observations are of the same reduced and the same eliminated block")
        reduced, place = reduced[order], place[order]
        return cls(
            order=order,
            reduced=reduced,
            place=place,
            place_of=tiling.place_of,
            num_reduced=num_reduced,
            num_places=tiling.num_tiles * TILE,
            families=tuple(families),
            num_extra=num_extra,
            columns=_columns(num_reduced, families, reduced),
            chunks=tuple(tiling.chunks(place, order, num_reduced)),
        )

    def with_families(self, families: Sequence[Family]) -> "SchurPlan":
        """The same observations with other shared unknowns."""
        columns = _columns(self.num_reduced, families, self.reduced)
        return replace(self, families=tuple(families), columns=columns)

    @cached_property
    def layout(self) -> RowLayout:
        """Of the rows of its observations."""
        return RowLayout.of(*(family.size for family in self.families))

    @property
    def num_shared(self) -> int:
        """How many unknowns the families have."""
        return sum(family.size * family.count for family in self.families)

    @property
    def size(self) -> int:
        """How many reduced unknowns there are."""
        return REDUCED_SIZE * self.num_reduced + self.num_shared + self.num_extra

    @cached_property
    def pairs(self) -> Int[Tensor, " pairs"]:
        """Codes, see `codes`, of all pairs of reduced blocks that meet in a tile, ascending."""
        codes = (torch.unique(self.codes(chunk)) for chunk in self.chunks)
        return torch.unique(torch.cat([self.order[:0], *codes]))

    def codes(self, chunk: Chunk) -> Int[Tensor, "tiles width width"]:
        """`row * (num_reduced + 1) + column` of the pairs of reduced blocks that each tile meets."""
        return chunk.reduced[:, :, None] * (self.num_reduced + 1) + chunk.reduced[:, None]

    @cached_property
    def gram_rows(self) -> GramRows:
        """Where the observations of each reduced block are, a stretch of CACHED observations at a time."""
        count, m = len(self.reduced), self.num_reduced
        stretch = torch.div(_range(count, self.reduced), CACHED, rounding_mode="floor")
        group, order = torch.sort(stretch * m + self.reduced, stable=True)
        size = torch.bincount(group, minlength=m * -(-count // CACHED))
        rows_of = (size + GRAM_ROWS - 1) // GRAM_ROWS
        owner = torch.repeat_interleave(_range(len(size), size), rows_of)
        row = _range(len(owner), owner) - (torch.cumsum(rows_of, dim=0) - rows_of)[owner]
        within = row[:, None] * GRAM_ROWS + _range(GRAM_ROWS, owner)
        index = (torch.cumsum(size, dim=0) - size)[owner][:, None] + within
        table = order[index.clamp(max=max(count - 1, 0))] % CACHED
        per_stretch = torch.cumsum(rows_of.view(-1, m).sum(dim=1), dim=0).tolist()
        return GramRows(torch.where(within < size[owner][:, None], table, CACHED), owner % m, per_stretch)


def _columns(num_reduced: int, families: Sequence[Family], like: Shaped[Tensor, "..."]) -> Int[Tensor, "blocks width"]:
    """Where the unknowns that the observations of each reduced block depend on are found among the reduced ones."""
    columns = [REDUCED_SIZE * _range(num_reduced, like)[:, None] + _range(REDUCED_SIZE, like)]
    first = REDUCED_SIZE * num_reduced
    for family in families:
        columns.append(first + family.size * family.member[:, None] + _range(family.size, like))
        first += family.size * family.count
    return torch.cat(columns, dim=1)


def _range(count: int, like: Shaped[Tensor, "..."]) -> Int[Tensor, " count"]:
    return torch.arange(count, device=like.device)


@dataclass(frozen=True)
class _Tiling:
    """A place for every eliminated block: tiles of neighbours, tiles that meet as many reduced blocks side by side.

    local (as given): which of the reduced blocks of its tile an observation is of. reduced: those of all tiles, one
    tile after the other; width: how many each has.
    """

    place_of: Int[Tensor, " eliminated"]
    num_tiles: int
    local: Ids
    reduced: Int[Tensor, " listed"]
    width: Int[Tensor, " tiles"]

    @classmethod
    def of(
        cls,
        reduced: Ids,
        eliminated: Ids,
        num_reduced: int,
        num_eliminated: int,
        locality: Shaped[Tensor, " eliminated"] | None,
    ) -> "_Tiling":
        if locality is None:
            count = torch.bincount(eliminated, minlength=num_eliminated).clamp(min=1)
            locality = torch.bincount(eliminated, weights=reduced.double(), minlength=num_eliminated) / count
        rank = torch.empty_like(eliminated.new_zeros(num_eliminated))
        rank[torch.argsort(locality, stable=True)] = _range(num_eliminated, eliminated)
        num_tiles = -(-num_eliminated // TILE)
        tile = rank // TILE
        met, which = torch.unique(tile[eliminated] * num_reduced + reduced, return_inverse=True)
        owner = torch.div(met, num_reduced, rounding_mode="floor")
        width = torch.bincount(owner, minlength=num_tiles)
        local = which - (torch.cumsum(width, dim=0) - width)[tile[eliminated]]
        by_width = torch.argsort(width, stable=True)
        new_tile = torch.empty_like(width)
        new_tile[by_width] = _range(num_tiles, eliminated)
        listed = (met % num_reduced)[torch.argsort(new_tile[owner], stable=True)]
        return cls(new_tile[tile] * TILE + rank % TILE, num_tiles, local, listed, width[by_width])

    def chunks(self, place: Ids, order: Ids, num_reduced: int) -> Iterator[Chunk]:
        """For observations in `order`, at `place`."""
        local, first = self.local[order], torch.cumsum(self.width, dim=0) - self.width
        starts = TILE * _range(self.num_tiles + 1, place)
        first_observation = torch.searchsorted(place, starts).tolist()
        for start, end, widest in _runs(self.width.tolist()):
            observations = slice(first_observation[start], first_observation[end])
            slots = _range(widest, place)
            index = (first[start:end, None] + slots).clamp(max=len(self.reduced) - 1)
            reduced = torch.where(slots < self.width[start:end, None], self.reduced[index], num_reduced)
            row = (place[observations] - start * TILE) * ELIMINATED_SIZE
            yield Chunk(slice(start, end), observations, reduced, row * widest + local[observations])


def _runs(widths: Sequence[int]) -> list[tuple[int, int, int]]:
    """Runs (first, end, greatest width) of tiles, whose widths ascend, that fit a chunk and are about as wide."""
    runs: list[tuple[int, int, int]] = []
    start = next((i for i, width in enumerate(widths) if width), len(widths))
    while start < len(widths):
        end = start + 1
        while (
            end < len(widths)
            and widths[end] <= widths[start] * CHUNK_GROWTH + 1
            and (end + 1 - start) * widths[end] * TILE * ELIMINATED_SIZE * REDUCED_SIZE <= CHUNK_ELEMENTS
        ):
            end += 1
        runs.append((start, end, widths[end - 1]))
        start = end
    return runs
