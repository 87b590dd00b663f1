"""Tiles of a raster against the raster in one piece."""

import pytest
import torch

from torchrefrac.dense import tiles
from torchrefrac.dense.rasterize import grid_of, rasterize
from torchrefrac.dense.tiles import count_tiles, raster_tiles
from torchrefrac.scene import DenseCloud

GRIDS = ("height", "sigma", "count", "colors", "valid", "filled", "views")


@pytest.fixture
def cloud(draw):
    """4000 points over 7 x 5, with holes, two surfaces in a part, and one point far away."""
    points = draw.uniform(0.0, 1.0, 4000, 3) * points_scale()
    points[:, 2] = torch.where(points[:, 0] < 2.0, points[:, 2], 0.1 * points[:, 0])
    points[17] = torch.tensor([500.0, 0.0, 0.0])
    points[18, 2] = torch.nan
    sigma = draw.power_of_ten(-3.0, -1.0, 4000)
    colors = torch.randint(256, (4000, 3), generator=draw.generator).to(torch.uint8)
    views = torch.randint(3, 9, (4000,), generator=draw.generator)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(4000, 3)
    return DenseCloud(points, up, colors, sigma, sigma, views, views, 0.5 * sigma, "m")


def points_scale():
    return torch.tensor([7.0, 5.0, 1.0], dtype=torch.float64)


@pytest.mark.parametrize("size", [16, 50, 1024])
def test_tiles_make_up_the_raster(monkeypatch, cloud, size):
    monkeypatch.setattr(tiles, "TILE", size)
    whole = rasterize(cloud, 0.1)
    grid, near = grid_of(cloud, 0.1)

    found = list(raster_tiles(cloud, grid, near))

    assert len(found) == count_tiles(grid) == -(-grid.rows // size) * -(-grid.columns // size)
    for name in GRIDS:
        values = getattr(whole, name)
        joined = torch.zeros_like(values)
        for tile in found:
            part = tile.inner(getattr(tile.raster, name))
            joined[tile.row : tile.row + part.shape[0], tile.column : tile.column + part.shape[1]] = part
        if name in ("height", "sigma", "views"):
            assert torch.allclose(joined, values, rtol=1e-6, atol=1e-9)
        else:
            assert torch.equal(joined, values)


def test_a_tile_knows_where_its_cells_are(monkeypatch, cloud):
    monkeypatch.setattr(tiles, "TILE", 16)
    whole = rasterize(cloud, 0.1)

    for tile in raster_tiles(cloud, *grid_of(cloud, 0.1)):
        rows, columns = tile.inner(tile.raster.height).shape
        assert torch.allclose(tile.raster.x[3:-3], whole.x[tile.column : tile.column + columns])
        assert torch.allclose(tile.raster.y[3:-3], whole.y[tile.row : tile.row + rows])
