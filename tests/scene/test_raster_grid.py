"""Cells of a raster, by where points lie."""

import pytest
import torch

from torchrefrac.scene import RasterGrid


@pytest.fixture
def grid():
    return RasterGrid(rows=4, columns=3, x_west=10.0, y_north=20.0, cell_size=0.5)


def test_rows_count_from_the_north_and_columns_from_the_west(grid):
    points = torch.tensor([[10.1, 19.9, 7.0], [11.4, 18.1, 7.0], [9.9, 20.1, 7.0], [12.0, 17.0, 7.0]])

    row, column = grid.steps_of(points)
    assert list(zip(row.tolist(), column.tolist(), strict=True)) == [(0, 0), (3, 2), (-1, -1), (6, 4)]
    row, column = grid.cells_of(points)
    assert list(zip(row.tolist(), column.tolist(), strict=True)) == [(0, 0), (3, 2), (0, 0), (3, 2)]


def test_a_part_has_the_same_cells(grid):
    part = grid.part(-1, 1, 3, 2)

    assert (part.rows, part.columns, part.x_west, part.y_north) == (3, 2, 10.5, 20.5)
    assert part.steps_of(torch.tensor([[10.6, 19.9]]))[0].tolist() == [1.0]
