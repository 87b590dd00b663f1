"""Lines of equal depth: where a plane has its depths, in the map's frame and in degrees."""

import json

import numpy as np
import pytest
import torch

from tests.files.rasters import raster_of
from torchrefrac.dense.rasterize import rasterize
from torchrefrac.files.contours import write_contours
from torchrefrac.scene import DenseCloud


@pytest.fixture
def slope():
    """Cells of 0.5 m, whose depth is 0.1 (x - 500000), and no surface in a corner."""
    x = 500_000.25 + 0.5 * torch.arange(80, dtype=torch.float64)
    height = -0.1 * (x - 500_000.0).expand(60, 80)
    valid = torch.ones(60, 80, dtype=torch.bool)
    valid[:10, :10] = False
    return raster_of(height.clone(), valid, x_west=500_000.0, y_north=5_000_030.0, cell_size=0.5)


def test_a_line_runs_where_the_depth_is_its_own(tmp_path, slope):
    count = write_contours(slope, tmp_path / "contours.geojson", 0.5)

    found = json.loads((tmp_path / "contours.geojson").read_text())
    assert len(found["features"]) == count == 7
    for feature in found["features"]:
        x, y = np.array(feature["geometry"]["coordinates"]).T
        assert x == pytest.approx(500_000.0 + 10.0 * feature["properties"]["depth"], abs=1e-3)
        assert (y.min(), y.max()) == (
            pytest.approx(5_000_000.25),
            pytest.approx(5_000_029.75 if x[0] > 500_005 else 5_000_024.75, abs=0.3),
        )


def test_on_the_map_lines_are_in_degrees(tmp_path, slope):
    pyproj = pytest.importorskip("pyproj")

    write_contours(slope, tmp_path / "contours.geojson", 1.0, "EPSG:32633")

    for feature in json.loads((tmp_path / "contours.geojson").read_text())["features"]:
        longitude, latitude = np.array(feature["geometry"]["coordinates"]).T
        east, _ = pyproj.Transformer.from_crs(4326, 32633, always_xy=True).transform(longitude, latitude)
        assert east == pytest.approx(500_000.0 + 10.0 * feature["properties"]["depth"], abs=1e-3)


def test_too_many_lines_are_refused_and_an_empty_raster_has_none(tmp_path, slope):
    with pytest.raises(ValueError, match=r"contours is 0\.001, which makes 39\d\d levels"):
        write_contours(slope, tmp_path / "contours.geojson", 0.001)
    assert not list(tmp_path.iterdir())
    assert write_contours(rasterize(DenseCloud.empty("m")), tmp_path / "contours.geojson", 1.0) == 0
