"""Points on the map, read back by laspy."""

import sys

import numpy as np
import pytest
import torch

from torchrefrac.files import las
from torchrefrac.files.las import LasPoints, PointClass, extent_of, require_las, write_las

laspy = pytest.importorskip("laspy")
ORIGIN = torch.tensor([412_345.0, 5_312_345.0, 428.0], dtype=torch.float64)


def _extent(points):
    return extent_of([points.coordinates])


@pytest.fixture
def points(draw):
    """Half a million metres north of the equator, some of the bed and some of the land."""
    coordinates = ORIGIN + draw.uniform(-50.0, 50.0, 1000, 3)
    classes = torch.where(coordinates[:, 2] < 428.0, int(PointClass.BATHYMETRIC), int(PointClass.GROUND))
    colors = torch.randint(256, (1000, 3), generator=draw.generator).to(torch.uint8)
    depth = (428.0 - coordinates[:, 2]).clamp(min=0.0)
    return LasPoints(coordinates, colors, classes, {"depth": (depth, "below the water's surface (m)")})


@pytest.mark.parametrize("name", ["points.las", "points.laz"])
def test_points_come_back_to_a_tenth_of_a_millimetre(tmp_path, points, name):
    written = []

    parts = [points[start : start + 300] for start in range(0, 1000, 300)]
    write_las(parts, tmp_path / name, _extent(points), "EPSG:32633", lambda count, _: written.append(count))
    read = laspy.read(tmp_path / name)

    assert written == [300, 300, 300, 100]
    assert (str(read.header.version), read.point_format.id) == ("1.4", 7)
    assert read.header.parse_crs().to_epsg() == 32633
    found = np.stack((read.x, read.y, read.z), axis=-1)
    assert np.abs(found - points.coordinates.numpy()).max() < 0.51e-4
    assert np.array_equal(read.classification, points.classes.numpy())
    assert np.array_equal(np.stack((read.red, read.green, read.blue), axis=-1), 257 * points.colors.numpy().astype(int))
    assert np.array_equal(read["depth"], points.extra["depth"][0].float().numpy())
    assert [dimension.description for dimension in read.point_format.extra_dimensions] == [
        "below the water's surface (m)"
    ]
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_compound_system_keeps_its_datum_of_heights(tmp_path, points):
    write_las([points], tmp_path / "points.laz", _extent(points), "EPSG:32633+5773")

    system = laspy.read(tmp_path / "points.laz").header.parse_crs()

    assert [part.to_epsg() for part in system.sub_crs_list] == [32633, 5773]


def test_a_cloud_as_large_as_a_country_has_coarser_steps(tmp_path, points):
    far = LasPoints(points.coordinates * 10.0, points.colors, points.classes)

    write_las([far], tmp_path / "points.laz", _extent(far))
    read = laspy.read(tmp_path / "points.laz")

    assert np.abs(np.stack((read.x, read.y, read.z), axis=-1) - far.coordinates.numpy()).max() < 0.51e-4
    spread = LasPoints(points.coordinates * 1e4, points.colors, points.classes)
    write_las([spread], tmp_path / "points.laz", _extent(spread))
    assert laspy.read(tmp_path / "points.laz").header.scales.tolist() == pytest.approx([1e-3, 1e-3, 1e-3])


def test_a_cloud_without_points_is_a_file_all_the_same(tmp_path, points):
    write_las([points[:0]], tmp_path / "points.laz", _extent(points[:0]))
    write_las([], tmp_path / "none.laz", _extent(points[:0]))

    assert len(laspy.read(tmp_path / "points.laz")) == len(laspy.read(tmp_path / "none.laz")) == 0


def test_what_cannot_be_written_is_refused_before_there_is_a_file(tmp_path, monkeypatch, points):
    with pytest.raises(ValueError, match="crs is 'Atlantis', which is no coordinate reference system"):
        write_las([points], tmp_path / "points.laz", _extent(points), "Atlantis")
    monkeypatch.setattr(las, "find_spec", lambda name: None if name == "lazrs" else sys)
    with pytest.raises(ImportError, match=r"pip install torchrefrac\[geo\]"):
        require_las()
    assert not list(tmp_path.iterdir())
