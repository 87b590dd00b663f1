"""A digital surface model on a grid of square cells, north up."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor


@dataclass(frozen=True)
class RasterGrid:
    """Square cells: row 0 is the northernmost, column 0 the westernmost; x_west, y_north: the outer corner of the first
    cell."""

    rows: int
    columns: int
    x_west: float
    y_north: float
    cell_size: float

    def part(self, row: int, column: int, rows: int, columns: int) -> "RasterGrid":
        """So many rows and columns of it, from one cell on, which may lie outside."""
        x_west, y_north = self.x_west + column * self.cell_size, self.y_north - row * self.cell_size
        return RasterGrid(rows, columns, x_west, y_north, self.cell_size)

    def steps_of(self, points: Float[Tensor, "n d"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Rows and columns, whole numbers, in which points lie by their x and y; outside of the grid they go on."""
        row = ((self.y_north - points[:, 1]) / self.cell_size).floor()
        return row, ((points[:, 0] - self.x_west) / self.cell_size).floor()

    def cells_of(self, points: Float[Tensor, "n d"]) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
        """Rows and columns of cells, the outermost ones of points that lie outside."""
        row, column = self.steps_of(points)
        return row.long().clamp(0, self.rows - 1), column.long().clamp(0, self.columns - 1)


@dataclass(frozen=True)
class Raster:
    """The surface on rows x columns square cells; row 0 is the northernmost (the largest y), column 0 the westernmost.

    height: world z of the surface, above the water surface, in length_unit; sigma: its standard deviation; count: how
    many points it is the mean of; views: by how many images one of these is seen, in the mean; valid: where there is a
    surface; filled: where it is not measured but interpolated between neighbours, a part of valid. Everything is zero
    where not valid. x_west, y_north: the outer corner of the first cell, in the world frame; cell_size: side of a cell,
    in length_unit.
    """

    height: Float[Tensor, "rows columns"]
    sigma: Float[Tensor, "rows columns"]
    count: Int[Tensor, "rows columns"]
    colors: UInt8[Tensor, "rows columns 3"]
    valid: Bool[Tensor, "rows columns"]
    filled: Bool[Tensor, "rows columns"]
    x_west: float
    y_north: float
    cell_size: float
    length_unit: str
    views: Float[Tensor, "rows columns"]

    @property
    def grid(self) -> RasterGrid:
        """Where its cells are."""
        rows, columns = self.height.shape
        return RasterGrid(rows, columns, self.x_west, self.y_north, self.cell_size)

    @property
    def depth(self) -> Float[Tensor, "rows columns"]:
        """Depth of the surface below the water surface, -height; negative on land."""
        return 0.0 - self.height

    @property
    def x(self) -> Float[Tensor, " columns"]:
        """World x of the centres of the cells, ascending."""
        columns = torch.arange(self.height.shape[1], dtype=self.height.dtype, device=self.height.device)
        return self.x_west + (columns + 0.5) * self.cell_size

    @property
    def y(self) -> Float[Tensor, " rows"]:
        """World y of the centres of the cells, descending."""
        rows = torch.arange(self.height.shape[0], dtype=self.height.dtype, device=self.height.device)
        return self.y_north - (rows + 0.5) * self.cell_size
