"""Rasters on the map, read back by rasterio alone."""

import sys

import numpy as np
import pytest
import torch

from tests.files.rasters import raster_of
from torchrefrac.dense.rasterize import rasterize
from torchrefrac.files.geotiff import Place, band_file, color_file, require_geotiff
from torchrefrac.scene import DenseCloud

rasterio = pytest.importorskip("rasterio")


@pytest.fixture
def raster():
    """(2, 3): three cells have a surface."""
    points = torch.tensor([[10.5, 7.5, 1.0], [12.5, 7.5, -2.0], [10.5, 5.5, -3.0]], dtype=torch.float64)
    three, colors = torch.ones(3, dtype=torch.float64), torch.tensor([[200, 100, 50]] * 3, dtype=torch.uint8)
    up = torch.tensor([[0.0, 0.0, 1.0]] * 3, dtype=torch.float64)
    counts = torch.full((3,), 4)
    return rasterize(DenseCloud(points, up, colors, 0.01 * three, three, counts, counts, 0.01 * three, "m"), 1.0)


def test_bands_have_names_units_and_values_where_they_are(tmp_path, raster):
    with band_file(tmp_path / "dsm.tif", ("height", "sigma"), Place.of(raster, "EPSG:32633"), "m") as file:
        file.write((raster.height, raster.sigma), raster.valid, 0, 0)

    assert [path.name for path in tmp_path.iterdir()] == ["dsm.tif"]
    with rasterio.open(tmp_path / "dsm.tif") as file:
        height, sigma = file.read(masked=True)
        assert file.dtypes == ("float32", "float32")
        assert file.descriptions == ("height", "sigma")
        assert file.units == ("m", "m")
        assert file.tags()["length_unit"] == "m"
        assert np.isnan(file.nodata)
        assert file.crs.to_epsg() == 32633
        assert tuple(file.bounds) == (10.0, 5.0, 13.0, 8.0)
        assert [value[0] for value in file.sample([(12.5, 7.5)])] == [-2.0]
    assert np.array_equal(height.mask, ~raster.valid.numpy())
    assert height.compressed().tolist() == [1.0, -2.0, -3.0]
    assert sigma.compressed().tolist() == pytest.approx([0.01] * 3)


def test_files_are_cloud_optimised_with_overviews(tmp_path, draw):
    large = raster_of(draw.normal(1200, 1500), y_north=1200.0)

    with band_file(tmp_path / "dsm.tif", ("height",), Place.of(large)) as file:
        for row in range(0, 1200, 700):
            part = slice(row, row + 700)
            file.write((large.height[part],), large.valid[part], row, 0)

    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.tags(ns="IMAGE_STRUCTURE")["COMPRESSION"] == "DEFLATE"
        assert file.block_shapes == [(512, 512)]
        assert file.overviews(1) == [2, 4]
        assert file.crs is None
        assert np.array_equal(file.read(1), large.height.float().numpy())


def test_a_picture_is_transparent_where_there_is_no_surface(tmp_path, raster):
    with color_file(tmp_path / "orthophoto.tif", Place.of(raster, "EPSG:32633+5773")) as file:
        file.write_colors(raster.colors, raster.valid, 0, 0)

    with rasterio.open(tmp_path / "orthophoto.tif") as file:
        assert [interpretation.name for interpretation in file.colorinterp] == ["red", "green", "blue", "alpha"]
        picture = file.read()
        assert file.crs.is_projected
    assert np.array_equal(picture[3] == 255, raster.valid.numpy())
    assert picture[:3, 0, 0].tolist() == [200, 100, 50]


def test_what_cannot_be_written_is_refused_by_name(tmp_path, raster):
    path, atlantis = tmp_path / "dsm.tif", Place.of(raster, "Atlantis")
    with (
        pytest.raises(ValueError, match="crs is 'Atlantis', which is no coordinate reference system"),
        band_file(path, ("height",), atlantis),
    ):
        pass
    empty = Place.of(rasterize(DenseCloud.empty("m")))
    with pytest.raises(ValueError, match=r"dsm\.tif has no cells"), band_file(path, ("height",), empty):
        pass
    with pytest.raises(KeyboardInterrupt), band_file(path, ("height",), Place.of(raster)):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_without_rasterio_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)

    with pytest.raises(ImportError, match=r"pip install torchrefrac\[geo\]"):
        require_geotiff()
