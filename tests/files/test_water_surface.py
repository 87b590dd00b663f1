"""Surfaces of water out of rasters and meshes."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torchrefrac.files.water_surface import read_water_surface
from torchrefrac.scene import SceneError

PLACE = torch.tensor(((512_003.0, 5_123_007.0),), dtype=torch.float64)


@pytest.fixture
def raster(tmp_path):
    """`raster(values, **options)`: a GeoTIFF of cells of 2 m whose first is at (512000, 5123010)."""
    rasterio = pytest.importorskip("rasterio")

    def write(values, transform=None, **options):
        place = transform or rasterio.Affine(2.0, 0.0, 512_000.0, 0.0, -2.0, 5_123_010.0)
        rows, columns = values.shape
        shape = {"height": rows, "width": columns, "count": 1, "dtype": values.dtype, "transform": place}
        with rasterio.open(tmp_path / "water.tif", "w", driver="GTiff", **shape, **options) as file:
            file.write(values, 1)
        return tmp_path / "water.tif"

    return write


def test_a_raster_has_heights_where_it_is_not_nodata_and_a_reference_system(raster):
    values = np.full((5, 5), 400.0, dtype=np.float32)
    values[:, 3:] = -9999.0

    water, crs = read_water_surface(raster(values, crs="EPSG:32633", nodata=-9999.0))

    beyond = PLACE + torch.tensor((5.0, 0.0), dtype=torch.float64)
    height, there = water.at(torch.cat((PLACE, beyond)))
    assert (height.tolist(), there.tolist()) == ([400.0, 0.0], [True, False])
    assert "UTM zone 33N" in str(crs)


@pytest.mark.parametrize("name", ["water.ply", "water.obj"])
def test_a_mesh_is_read_with_all_digits(tmp_path, name):
    rows = ("512000 5123000 400.125", "512010 5123000 400.125", "512000 5123010 400.125")
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    texts = {
        "water.obj": "".join(f"v {row}\n" for row in rows) + "f 1 2 3\n",
        "water.ply": f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}element face 1\n"
        "property list uchar int vertex_indices\nend_header\n" + "\n".join((*rows, "3 0 1 2")) + "\n",
    }
    (tmp_path / name).write_text(texts[name])

    water, crs = read_water_surface(tmp_path / name)

    height, there = water.at(PLACE)
    assert (there.tolist(), crs) == ([True], None)
    assert float(height) == pytest.approx(400.125, abs=1e-6)


def test_what_is_no_surface_is_refused_in_one_sentence(tmp_path, raster):
    rasterio = pytest.importorskip("rasterio")
    (tmp_path / "text.tif").write_text("no raster")
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n1 2 3\n"
    )
    (tmp_path / "water.txt").write_text("400")
    turned = rasterio.Affine(2.0, 0.5, 512_000.0, 0.5, -2.0, 5_123_010.0)
    cases = {
        Path("none.tif"): "is not a file",
        tmp_path / "water.txt": r"must end in \.tif, \.tiff, \.ply, \.obj",
        tmp_path / "text.tif": "cannot be read as a raster",
        tmp_path / "points.ply": "has no triangles|cannot be read as a mesh",
    }
    for path, sentence in cases.items():
        with pytest.raises(SceneError, match=sentence):
            read_water_surface(path)
    with pytest.raises(SceneError, match="resample it north up"):
        read_water_surface(raster(np.ones((2, 2), dtype=np.float32), turned))
    with pytest.raises(SceneError, match="has no cell with a height"):
        read_water_surface(raster(np.full((2, 2), np.nan, dtype=np.float32)))
