"""The map of a raster: drawn for any of them, north up, and grey where there is nothing."""

import cv2
import numpy as np
import pytest
import torch

from tests.files.rasters import raster_of as plain_raster
from torchrefrac.figures.raster import EMPTY, draw_raster


def raster_of(height, valid=None):
    """A raster of cells of 0.5 m; the south-western corner is at (10, 20)."""
    height = torch.as_tensor(height, dtype=torch.float64)
    return plain_raster(height, valid, x_west=10.0, y_north=20.0 + 0.5 * len(height), cell_size=0.5)


@pytest.fixture
def seabed():
    """(60, 80): from 1 m of land in the west to 5 m of water in the east, and a hole."""
    row, column = torch.meshgrid(torch.arange(60), torch.arange(80), indexing="ij")
    valid = (row - 20) ** 2 + (column - 50) ** 2 > 100
    return raster_of(1.0 - 6.0 * column / 79 + 0.2 * torch.sin(row / 5.0), valid)


@pytest.mark.parametrize(
    "shape", [(0, 0), (1, 1), (1, 30), (30, 1), (2, 2), (40, 25), (200, 3000), (1, 5000), (5000, 1)]
)
@pytest.mark.parametrize("is_flat", [True, False])
def test_a_raster_of_any_shape_is_drawn(tmp_path, draw, shape, is_flat):
    height = -torch.ones(shape) if is_flat else draw.uniform(-3.0, 1.0, *shape)

    draw_raster(raster_of(height), tmp_path / "dsm.png")

    image = cv2.imread(str(tmp_path / "dsm.png"))
    assert min(image.shape[:2]) > 200
    assert image.std() > 5
    assert [path.name for path in tmp_path.iterdir()] == ["dsm.png"]


def test_a_raster_without_a_surface_is_drawn(tmp_path):
    draw_raster(raster_of(torch.zeros(20, 20), torch.zeros(20, 20, dtype=torch.bool)), tmp_path / "dsm.png")

    assert _share_of(tmp_path / "dsm.png", EMPTY) > 0.3


def test_the_hole_is_neutral_and_lies_where_it_is_with_north_up(tmp_path, seabed):
    draw_raster(seabed, tmp_path / "dsm.png")

    image = cv2.imread(str(tmp_path / "dsm.png"))
    is_empty = (image == _bgr(EMPTY)).all(axis=-1)
    row, column = (axis.mean() for axis in np.nonzero(is_empty))
    assert 0.25 < row / image.shape[0] < 0.5
    assert 0.45 < column / image.shape[1] < 0.7
    assert 0.02 < is_empty.mean() < 0.08


def test_shallow_water_is_light_and_deep_water_dark(tmp_path, seabed):
    draw_raster(seabed, tmp_path / "dsm.png")

    gray = cv2.imread(str(tmp_path / "dsm.png"), cv2.IMREAD_GRAYSCALE)
    middle, width = gray[gray.shape[0] * 7 // 10], gray.shape[1]
    assert np.median(middle[width * 12 // 100 : width * 18 // 100]) > 1.8 * np.median(
        middle[width * 72 // 100 : width * 78 // 100]
    )


def _bgr(color):
    return [int(color[i : i + 2], 16) for i in (5, 3, 1)]


def _share_of(path, color):
    return (cv2.imread(str(path)) == _bgr(color)).all(axis=-1).mean()
