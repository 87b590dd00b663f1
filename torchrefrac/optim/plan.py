"""What a bundle adjustment looks like before any number is known: who sees what, in which order, in which tiles.

The order is chosen for the Schur complement. Points that are seen by the same cameras lie side by side and are cut into
tiles of `TILE` points; what a tile adds to the reduced system is one small dense matrix product over the few cameras
that see it. Tiles with as many cameras lie side by side, so that they can be multiplied as a batch.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

TILE = 64
CAMERA_SIZE = 6
POINT_SIZE = 3
CHUNK_ELEMENTS = 1 << 19
CHUNK_GROWTH = 1.15
GRAM_ROWS = 64
CACHED = 16384


class Family(NamedTuple):
    """`size` unknowns that come in `count` copies, of which every camera has one: of_camera (m).

    A lens for each of several cameras that took turns, a water level for each of several days.
    """

    size: int
    of_camera: Tensor
    count: int = 1


class Chunk(NamedTuple):
    """Consecutive tiles, multiplied together.

    tiles, observations: the first and the end of each. cameras (B, C): who sees each of B tiles, ascending, filled up
    with m. place (k): where the first row of each observation goes in a buffer of (B * TILE * 3, C) blocks.
    """

    tiles: slice
    observations: slice
    cameras: Tensor
    place: Tensor


class GramRows(NamedTuple):
    """Observations of one camera in rows of GRAM_ROWS, counted within their stretch of CACHED (k, GRAM_ROWS) and
    filled up with CACHED; whose each row is (k); and how many rows there are up to the end of each stretch."""

    table: Tensor
    owner: Tensor
    ends: list[int]


@dataclass(frozen=True)
class SchurPlan:
    """The structure of the normal equations; everything in `order`, an arrangement of the observations given.

    camera, point (N): ids, the latter as places among `num_places` (tiles are filled up). place_of_point (n). The
    reduced unknowns are 6 for each of m cameras, those of the families, and `num_extra` more that no point depends on;
    columns (m, w): where those that the observations of a camera depend on are found among them.
    """

    order: Tensor
    camera: Tensor
    point: Tensor
    place_of_point: Tensor
    num_cameras: int
    num_places: int
    families: tuple[Family, ...]
    num_extra: int
    columns: Tensor
    chunks: tuple[Chunk, ...]

    @classmethod
    def create(
        cls,
        camera: Tensor,
        point: Tensor,
        num_cameras: int,
        num_points: int,
        families: Sequence[Family] = (),
        num_extra: int = 0,
        locality: Tensor | None = None,
    ) -> "SchurPlan":
        """Plan for observations of `point` (N) by `camera` (N), in any order, no pair twice.

        locality (n), whole numbers: points of near values are seen by the same cameras (a place on a curve that fills
        space); by default the mean of their cameras' ids.
        """
        tiling = _Tiling.of(camera, point, num_cameras, num_points, locality)
        place = tiling.place_of_point[point]
        pair, order = torch.sort(place * num_cameras + camera)
        if bool((pair[1:] == pair[:-1]).any()):
            raise ValueError("a camera sees a point twice; each pair of camera and point may occur once")
        camera, place = camera[order], place[order]
        return cls(
            order=order,
            camera=camera,
            point=place,
            place_of_point=tiling.place_of_point,
            num_cameras=num_cameras,
            num_places=tiling.num_tiles * TILE,
            families=tuple(families),
            num_extra=num_extra,
            columns=_columns(num_cameras, families, camera),
            chunks=tuple(tiling.chunks(place, order, num_cameras)),
        )

    def with_families(self, families: Sequence[Family]) -> "SchurPlan":
        """The same observations with other shared unknowns."""
        columns = _columns(self.num_cameras, families, self.camera)
        return replace(self, families=tuple(families), columns=columns)

    @property
    def num_shared(self) -> int:
        """How many unknowns the families have."""
        return sum(family.size * family.count for family in self.families)

    @property
    def size(self) -> int:
        """How many reduced unknowns there are."""
        return CAMERA_SIZE * self.num_cameras + self.num_shared + self.num_extra

    @cached_property
    def gram_rows(self) -> "GramRows":
        """Where the observations of each camera are, a stretch of CACHED observations at a time."""
        count, m = len(self.camera), self.num_cameras
        stretch = torch.div(_range(count, self.camera), CACHED, rounding_mode="floor")
        group, order = torch.sort(stretch * m + self.camera, stable=True)
        size = torch.bincount(group, minlength=m * -(-count // CACHED))
        rows_of = (size + GRAM_ROWS - 1) // GRAM_ROWS
        owner = torch.repeat_interleave(_range(len(size), size), rows_of)
        row = _range(len(owner), owner) - (torch.cumsum(rows_of, dim=0) - rows_of)[owner]
        within = row[:, None] * GRAM_ROWS + _range(GRAM_ROWS, owner)
        index = (torch.cumsum(size, dim=0) - size)[owner][:, None] + within
        table = order[index.clamp(max=max(count - 1, 0))] % CACHED
        per_stretch = torch.cumsum(rows_of.view(-1, m).sum(dim=1), dim=0).tolist()
        return GramRows(torch.where(within < size[owner][:, None], table, CACHED), owner % m, per_stretch)


def _columns(num_cameras: int, families: Sequence[Family], like: Tensor) -> Tensor:
    """Where the unknowns that each camera depends on are found among the reduced ones (m, w)."""
    columns = [CAMERA_SIZE * _range(num_cameras, like)[:, None] + _range(CAMERA_SIZE, like)]
    first = CAMERA_SIZE * num_cameras
    for family in families:
        columns.append(first + family.size * family.of_camera[:, None] + _range(family.size, like))
        first += family.size * family.count
    return torch.cat(columns, dim=1)


def _range(count: int, like: Tensor) -> Tensor:
    return torch.arange(count, device=like.device)


@dataclass(frozen=True)
class _Tiling:
    """A place for every point (n): tiles of neighbours, tiles with as many cameras side by side.

    local (N, as given): which of the cameras of its tile an observation is from. cameras: of all tiles, one after the
    other; width (num_tiles): how many each has.
    """

    place_of_point: Tensor
    num_tiles: int
    local: Tensor
    cameras: Tensor
    width: Tensor

    @classmethod
    def of(cls, camera: Tensor, point: Tensor, num_cameras: int, num_points: int, locality: Tensor | None) -> "_Tiling":
        if locality is None:
            count = torch.bincount(point, minlength=num_points).clamp(min=1)
            locality = torch.bincount(point, weights=camera.double(), minlength=num_points) / count
        rank = torch.empty_like(point.new_zeros(num_points))
        rank[torch.argsort(locality, stable=True)] = _range(num_points, point)
        num_tiles = -(-num_points // TILE)
        tile = rank // TILE
        seen, which = torch.unique(tile[point] * num_cameras + camera, return_inverse=True)
        owner = torch.div(seen, num_cameras, rounding_mode="floor")
        width = torch.bincount(owner, minlength=num_tiles)
        local = which - (torch.cumsum(width, dim=0) - width)[tile[point]]
        by_width = torch.argsort(width, stable=True)
        new_tile = torch.empty_like(width)
        new_tile[by_width] = _range(num_tiles, point)
        cameras = (seen % num_cameras)[torch.argsort(new_tile[owner], stable=True)]
        return cls(new_tile[tile] * TILE + rank % TILE, num_tiles, local, cameras, width[by_width])

    def chunks(self, place: Tensor, order: Tensor, num_cameras: int) -> Iterator[Chunk]:
        """For observations in `order` (N), at `place` (N)."""
        local, first = self.local[order], torch.cumsum(self.width, dim=0) - self.width
        starts = TILE * _range(self.num_tiles + 1, place)
        first_observation = torch.searchsorted(place, starts).tolist()
        for start, end, widest in _runs(self.width.tolist()):
            observations = slice(first_observation[start], first_observation[end])
            slots = _range(widest, place)
            index = (first[start:end, None] + slots).clamp(max=len(self.cameras) - 1)
            cameras = torch.where(slots < self.width[start:end, None], self.cameras[index], num_cameras)
            row = (place[observations] - start * TILE) * POINT_SIZE
            yield Chunk(slice(start, end), observations, cameras, row * widest + local[observations])


def _runs(widths: Sequence[int]) -> list[tuple[int, int, int]]:
    """Runs (first, end, greatest width) of tiles, whose widths ascend, that fit a chunk and are about as wide."""
    runs: list[tuple[int, int, int]] = []
    start = next((i for i, width in enumerate(widths) if width), len(widths))
    while start < len(widths):
        end = start + 1
        while (
            end < len(widths)
            and widths[end] <= widths[start] * CHUNK_GROWTH + 1
            and (end + 1 - start) * widths[end] * TILE * POINT_SIZE * CAMERA_SIZE <= CHUNK_ELEMENTS
        ):
            end += 1
        runs.append((start, end, widths[end - 1]))
        start = end
    return runs
