"""The surface of a cloud on a grid, tile by tile: of rasters, and of clouds in files, that are larger than memory."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.dense.rasterize import CHUNK, Points, in_chunks, raster_in, sharpest_of
from torchrefrac.scene import DenseCloud, Raster, RasterGrid

TILE = 1024
MARGIN = 3
"""Cells around a tile that it is made with: what is well supported looks at eight neighbours, a hole at those of its
eight, and slopes of the relief at one more."""


@dataclass(frozen=True)
class Tile:
    """A part of a raster, from one of its cells on. raster: with MARGIN more cells on each side."""

    row: int
    column: int
    raster: Raster

    def inner(self, values: Shaped[Tensor, "rows columns *more"]) -> Shaped[Tensor, "inner_rows inner_columns *more"]:
        """Values of the raster's cells without those of the margin."""
        return values[MARGIN:-MARGIN, MARGIN:-MARGIN]


def count_tiles(grid: RasterGrid) -> int:
    """How many tiles a grid has."""
    down, across = _tiled(grid)
    return down * across


def _tiled(grid: RasterGrid) -> tuple[int, int]:
    """Rows and columns of tiles."""
    return -(-grid.rows // TILE), -(-grid.columns // TILE)


def raster_tiles(points: Points, grid: RasterGrid, near: Bool[Tensor, " n"]) -> Iterator[Tile]:
    """The raster that `rasterize` makes of the points that are near, in tiles of 1024 x 1024 cells, row by row.

    Of each point a number stays in memory, and of a tile what lies in it. points: a cloud, or a file of one.
    """
    tile, sigma = _tiles_of(points, grid, near)
    sharpest = sharpest_of(sigma[near])
    del sigma
    down, across = _tiled(grid)
    order = tile.argsort(stable=True)
    start = torch.searchsorted(tile[order], torch.arange(down * across + 1, dtype=tile.dtype)).tolist()
    del tile
    for i in range(down):
        for j in range(across):
            around = [
                order[start[k * across + m] : start[k * across + m + 1]]
                for k in range(max(i - 1, 0), min(i + 2, down))
                for m in range(max(j - 1, 0), min(j + 2, across))
            ]
            rows, columns = min(TILE, grid.rows - i * TILE), min(TILE, grid.columns - j * TILE)
            part = grid.part(i * TILE - MARGIN, j * TILE - MARGIN, rows + 2 * MARGIN, columns + 2 * MARGIN)
            yield Tile(i * TILE, j * TILE, _raster_of(points, torch.cat(around), part, sharpest))


def _raster_of(points: Points, rows: Int[Tensor, " k"], part: RasterGrid, sharpest: float) -> Raster:
    """Of those of some points that lie in a part of the grid, of which a chunk is looked at at once."""
    inside = []
    for some in rows.sort().values.long().split(CHUNK):
        cloud = points[some]
        row, column = part.steps_of(cloud.points)
        inside.append(cloud[(row >= 0) & (row < part.rows) & (column >= 0) & (column < part.columns)])
    return raster_in(DenseCloud.joined(inside), part, sharpest)


def _tiles_of(
    points: Points, grid: RasterGrid, near: Bool[Tensor, " n"]
) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"]]:
    """In which tile each point lies, those that do not count in one after the last; and their sigmas."""
    (down, across), none = _tiled(grid), count_tiles(grid)
    tile = torch.full((len(points),), none, dtype=torch.int32)
    sigma = torch.zeros(len(points), dtype=torch.float32)
    for rows, some in in_chunks(points):
        row, column = (step.nan_to_num() // TILE for step in grid.steps_of(some.points))
        number = row.clamp(0, down - 1) * across + column.clamp(0, across - 1)
        tile[rows] = torch.where(near[rows], number, none).int()
        sigma[rows] = some.sigma.float()
    return tile, sigma
