"""Clouds and rasters on the map, as other programs read them."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from tests.dense.flights import BED, flight  # noqa: F401 - a fixture
from torchrefrac.commands.survey_products import dense_points, require_place, write_survey_products
from torchrefrac.config import DenseOutputs, OptionError
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import DenseCloud, Georeference

laspy = pytest.importorskip("laspy")
rasterio = pytest.importorskip("rasterio")
PLACE = Georeference("EPSG:32633", (412_345.0, 5_312_345.0, 431.0), scale=0.9996)


@pytest.fixture
def scene(flight):  # noqa: F811
    return replace(flight((1.0, 1.0, 1.0)), georeference=PLACE)


@pytest.fixture
def cloud():
    """The bed every 5 cm, and a strip of land in the north."""
    x, y = (part.flatten() for part in torch.meshgrid(*(torch.arange(-2.0, 2.0, 0.05),) * 2, indexing="ij"))
    z = torch.where(y > 1.5, 0.4, BED)
    points, n = torch.stack((x, y, z), dim=-1).double(), len(x)
    sigma = torch.full((n,), 0.02, dtype=torch.float64)
    counts, up = torch.full((n,), 3), torch.tensor((0.0, 0.0, 1.0)).double().expand(n, 3)
    colors = torch.full((n, 3), 99, dtype=torch.uint8)
    axes = torch.tensor((0.01, 0.02, 0.03)).double().expand(n, 3)
    reference = torch.arange(n) % 3
    return DenseCloud(points, up, colors, sigma, 0.9 + 0.0 * sigma, counts, reference, sigma, "m", axes, 0.5 * sigma)


def test_everything_stands_on_the_map_with_heights_in_the_datum(tmp_path, scene, cloud):
    outputs = DenseOutputs(geotiff=True, laz=True, contours=0.5)

    metrics = write_survey_products(cloud, scene, outputs, tmp_path, SilentRecorder())

    read = laspy.read(tmp_path / "dense.laz")
    land = cloud.points[:, 2].numpy() > 0.0
    assert np.allclose(read.x, 412_345.0 + 0.9996 * cloud.points[:, 0].numpy(), atol=1e-4)
    assert np.allclose(read.z, 431.0 + cloud.points[:, 2].numpy(), atol=1e-4)
    assert np.array_equal(read.classification, np.where(land, 2, 40))
    assert np.allclose(read["depth"], np.where(land, 0.0, 2.0))
    assert np.allclose(read["sigma_y"], 0.02)
    assert set(read["views"]) == {3.0}
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert file.crs.to_epsg() == 32633
        east, north = 412_345.0, 5_312_345.0 - 0.9996
        assert next(file.sample([(east, north)]))[0] == pytest.approx(429.0, abs=1e-4)
        assert next(file.sample([(east, north + 2.7)]))[0] == pytest.approx(431.4, abs=1e-4)
    with rasterio.open(tmp_path / "depth.tif") as file:
        assert next(file.sample([(east, north)]))[0] == pytest.approx(2.0)
        assert math.isnan(next(file.sample([(east, north + 2.7)]))[0])  # land has no depth
    with rasterio.open(tmp_path / "sigma.tif") as file:
        sigma, tvu = file.read()
        assert np.nanmin(sigma) >= 0.01  # what all points have in common
        assert np.nanmax(np.abs(tvu / sigma - 1.96)) < 1e-3
    with rasterio.open(tmp_path / "orthophoto.tif") as file:
        assert file.res[0] < 0.1
        assert file.count == 4
    assert json.loads((tmp_path / "contours.geojson").read_text())["type"] == "FeatureCollection"
    assert metrics["depth_median_m"] == pytest.approx(2.0)
    assert metrics["s44_exclusive_percent"] == 100.0
    assert metrics["bed_area_m2"] == pytest.approx(4.0 * 3.5 * 0.9996**2, rel=0.05)


def test_over_a_river_that_falls_heights_are_level_and_depths_from_the_water_above(tmp_path, scene, cloud):
    sloping = replace(PLACE, slope=(0.02, -0.01))
    outputs = DenseOutputs(geotiff=True, laz=True)

    write_survey_products(cloud, replace(scene, georeference=sloping), outputs, tmp_path, SilentRecorder())

    level = sloping.coordinates(cloud.points)
    read = laspy.read(tmp_path / "dense.laz")
    assert np.allclose(np.stack((read.x, read.y, read.z), axis=-1), level.numpy(), atol=1e-4)
    rows = np.flatnonzero((cloud.points[:, :2].abs() < 0.8).all(dim=-1).numpy())[::97]
    with rasterio.open(tmp_path / "dsm.tif") as dsm, rasterio.open(tmp_path / "depth.tif") as depth:
        at = level[rows, :2].tolist()
        bed = np.array([value[0] for value in dsm.sample(at)])
        below = np.array([value[0] for value in depth.sample(at)])
    assert np.allclose(bed, level[rows, 2].numpy(), atol=2e-3)  # half a cell of that slope
    assert np.allclose(bed + below, sloping.water_heights(*level[rows, :2].T).numpy(), atol=2e-3)
    assert np.ptp(bed) > 0.02
    with rasterio.open(tmp_path / "orthophoto.tif") as file:
        assert file.read(4).any()


def test_without_a_place_files_have_the_numbers_of_the_scene(tmp_path, scene, cloud):
    nowhere = replace(scene, georeference=None)

    write_survey_products(cloud, nowhere, DenseOutputs(laz=True), tmp_path, SilentRecorder())

    read = laspy.read(tmp_path / "dense.laz")
    assert np.allclose(np.stack((read.x, read.y, read.z), axis=-1), cloud.points.numpy(), atol=1e-4)
    assert read.header.parse_crs() is None


def test_incidence_is_that_of_the_quickest_path(scene, cloud):
    some = cloud[torch.arange(0, len(cloud), 97)]

    found = dense_points(some, scene, PLACE).extra["incidence"][0]

    for point, view, angle in zip(some.points.tolist(), some.reference.tolist(), found.tolist(), strict=True):
        center = scene.views.center[view].tolist()
        away = math.hypot(point[0] - center[0], point[1] - center[1])
        if point[2] > 0.0:
            expected = math.atan2(away, center[2] - point[2])
        else:
            at = _refrax_distance(center[2], -point[2], away)
            expected = math.atan2(at, center[2])
        assert angle == pytest.approx(math.degrees(expected), abs=1e-5)


def _refrax_distance(height, depth, away):
    """How far from the camera, horizontally, the quickest path meets the water."""
    return brentq(lambda r: r / math.hypot(r, height) - 1.333 * (away - r) / math.hypot(away - r, depth), 0.0, away)


def test_a_reference_system_must_be_the_one_that_positions_are_in():
    require_place(DenseOutputs(), None)
    require_place(DenseOutputs(geotiff=True, crs="EPSG:32633"), PLACE)
    require_place(DenseOutputs(geotiff=True, crs="EPSG:32633+5773"), replace(PLACE, vertical="EPSG:5773"))
    with pytest.raises(OptionError, match=r"in EPSG:32633; import the photographs with crs=EPSG:25833"):
        require_place(DenseOutputs(geotiff=True, crs="EPSG:25833"), PLACE)
    for crs, problem in (("EPSG:4326", "has no axes in metres"), ("EPSG:99999", "is not known to pyproj")):
        with pytest.raises(OptionError, match=f"georeference: crs '{crs}' {problem}"):
            require_place(DenseOutputs(laz=True), replace(PLACE, crs=crs))
    with pytest.raises(OptionError, match="does not say where its frame stands"):
        require_place(DenseOutputs(geotiff=True, crs="EPSG:25833"), None)
