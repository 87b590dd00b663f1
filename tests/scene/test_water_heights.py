"""Heights of water at places, against a look at single cells and triangles."""

import math

import pytest
import torch

from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.scene import GridWater, LevelWater, MeshWater

WEST, NORTH, CELL = 512_000.0, 5_123_040.0, (2.0, 4.0)


def slow(heights, known, x, y):
    """Of the four centres of cells around a place."""
    rows, columns = len(heights), len(heights[0])
    column, row = (x - WEST) / CELL[0], (NORTH - y) / CELL[1]
    if not (0.0 <= column <= columns and 0.0 <= row <= rows):
        return None
    i, j = min(int(row), rows - 1), min(int(column), columns - 1)
    if not known[i][j]:
        return None
    u, v = min(max(column - 0.5, 0.0), columns - 1.0), min(max(row - 0.5, 0.0), rows - 1.0)
    left, top = math.floor(u), math.floor(v)
    total = 0.0
    for k in (top, top + 1):
        for m in (left, left + 1):
            share = (1.0 - abs(v - k)) * (1.0 - abs(u - m))
            if share > 0.0:
                total += share * heights[k][m]
                if not known[k][m]:
                    return heights[i][j]
    return total


def test_a_grid_is_bilinear_between_cells_that_are_known(draw):
    height, known = draw.uniform(400.0, 401.0, 10, 20), draw.uniform(0.0, 1.0, 10, 20) > 0.1
    places = torch.stack((WEST + draw.uniform(-2.0, 42.0, 2000), NORTH - draw.uniform(-2.0, 42.0, 2000)), dim=-1)

    found, there = GridWater(height, known, WEST, NORTH, CELL).at(places)

    expected = [slow(height.tolist(), known.tolist(), x, y) for x, y in places.tolist()]
    assert there.tolist() == [value is not None for value in expected]
    close = torch.tensor([value or 0.0 for value in expected], dtype=torch.float64)
    torch.testing.assert_close(found, close, rtol=0.0, atol=1e-9)
    assert 0 < int(there.sum()) < 2000


def test_a_grid_of_one_cell_is_level():
    one = torch.tensor(((3.0,),), dtype=torch.float64)

    found, there = GridWater(one, one > 0.0, 0.0, 1.0, (1.0, 1.0)).at(
        torch.tensor(((0.2, 0.9), (1.2, 0.9)), dtype=torch.float64)
    )

    assert (found.tolist(), there.tolist()) == ([3.0, 0.0], [True, False])


@pytest.mark.parametrize("origin", [(0.0, 0.0), (512_000.0, 5_123_000.0)])
def test_triangles_are_planes_with_nothing_beyond(draw, origin):
    x, y = origin
    corners = torch.tensor(
        ((x, y, 5.0), (x + 10.0, y, 6.0), (x, y + 10.0, 5.5), (x + 10.0, y + 10.0, 6.5)), dtype=torch.float64
    )
    water = MeshWater(TriangleMesh(corners, torch.tensor(((0, 1, 2), (1, 3, 2)))))
    places = torch.tensor(origin, dtype=torch.float64) + draw.uniform(-1.0, 11.0, 500, 2)

    found, there = water.at(places)

    u, v = ((places - torch.tensor(origin, dtype=torch.float64)) / 10.0).unbind(dim=-1)
    inside = (u >= 0.0) & (u <= 1.0) & (v >= 0.0) & (v <= 1.0)
    assert torch.equal(there, inside)
    torch.testing.assert_close(found, torch.where(inside, 5.0 + u + 0.5 * v, 0.0), rtol=0.0, atol=1e-8)


def test_a_level_is_the_same_everywhere(draw):
    found, there = LevelWater(2.5).at(draw.uniform(-1.0, 1.0, 3, 2))

    assert (found.tolist(), there.tolist()) == ([2.5] * 3, [True] * 3)
