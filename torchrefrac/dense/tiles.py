"""The surface of a cloud on a grid, tile by tile: of rasters, and of clouds in files, that are larger than memory."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchrefrac.dense.rasterize import CHUNK, Points, RasterGrid, raster_in, sharpest_of
from torchrefrac.scene import Raster

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
    return -(-grid.rows // TILE) * -(-grid.columns // TILE)


def raster_tiles(points: Points, grid: RasterGrid, near: Bool[Tensor, " n"]) -> Iterator[Tile]:
    """The raster that `rasterize` makes of the points that are near, in tiles of 1024 x 1024 cells, row by row.

    Of each point a number stays in memory, and of a tile what lies in it. points: a cloud, or a file of one.
    """
    tile, sigma = _tiles_of(points, grid, near)
    sharpest = sharpest_of(sigma[near])
    del sigma
    down, across = -(-grid.rows // TILE), -(-grid.columns // TILE)
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
    """Of those of some points that lie in a part of the grid."""
    cloud = points[rows.sort().values.long()]
    row = ((part.y_north - cloud.points[:, 1]) / part.cell_size).floor()
    column = ((cloud.points[:, 0] - part.x_west) / part.cell_size).floor()
    inside = (row >= 0) & (row < part.rows) & (column >= 0) & (column < part.columns)
    return raster_in(cloud[inside], part, sharpest)


def _tiles_of(
    points: Points, grid: RasterGrid, near: Bool[Tensor, " n"]
) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"]]:
    """In which tile each point lies, those that do not count in one after the last; and their sigmas."""
    across, none = -(-grid.columns // TILE), count_tiles(grid)
    tile = torch.full((len(points),), none, dtype=torch.int32)
    sigma = torch.zeros(len(points), dtype=torch.float32)
    for start in range(0, len(points), CHUNK):
        rows = torch.arange(start, min(start + CHUNK, len(points)))
        some = points[rows]
        row = (
            ((grid.y_north - some.points[:, 1]) / grid.cell_size / TILE).floor().clamp(0, max(grid.rows - 1, 0) // TILE)
        )
        column = ((some.points[:, 0] - grid.x_west) / grid.cell_size / TILE).floor()
        column = column.clamp(0, max(grid.columns - 1, 0) // TILE)
        tile[rows] = torch.where(near[rows], row.nan_to_num() * across + column.nan_to_num(), none).int()
        sigma[rows] = some.sigma.float()
    return tile, sigma
