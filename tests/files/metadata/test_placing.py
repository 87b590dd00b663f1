"""Positions in one frame: against formulas of the projection, and where they do not fit together."""

import math

import numpy as np
import pytest
import torch

from torchrefrac.files.metadata import local_frame, placing
from torchrefrac.files.metadata.local_frame import Grid, zone_of
from torchrefrac.files.metadata.placing import Place, place_all
from torchrefrac.files.metadata.position import Vertical
from torchrefrac.scene import CaptureError, Georeference

E, S, T, STATED = Vertical.ELLIPSOID, Vertical.SEA_LEVEL, Vertical.TAKE_OFF, Vertical.TABLE
FIRST = {S: 200.0, T: 40.0}


def degrees(latitude, longitude, altitudes=FIRST, sigma=(1.5, 3.0)):
    return Place((latitude, longitude), None, altitudes, sigma)


def point(east, north, altitudes=None):
    return Place(None, (east, north), altitudes or {STATED: 12.0}, (0.02, 0.03))


@pytest.mark.parametrize(
    ("latitude", "longitude", "zone"),
    [
        (46.8, -92.0, "EPSG:32615"),
        (-33.9, 151.2, "EPSG:32756"),
        (0.5, 179.9, "EPSG:32660"),
        (60.0, 3.0, "EPSG:32631"),
        (-1.0, -180.0, "EPSG:32701"),
    ],
)
def test_the_zone_is_that_of_the_place(latitude, longitude, zone):
    assert zone_of([latitude], [longitude]) == zone


def test_at_the_date_line_the_zone_is_that_of_the_middle():
    assert zone_of([10.0, 10.0], [179.99, -179.97]) == "EPSG:32601"


@pytest.mark.parametrize(("latitude", "longitude"), [(46.84, -91.99), (-33.9, 151.2), (5.0, 14.5), (60.0, 10.9)])
def test_north_is_turned_by_the_convergence_of_meridians(latitude, longitude):
    """tan(convergence) = tan(difference of longitude) sin(latitude), on a sphere; the ellipsoid changes thousandths."""
    pytest.importorskip("pyproj")
    grid = Grid(zone_of([latitude], [longitude]))
    middle = 6.0 * math.floor((longitude + 180.0) / 6.0) - 177.0
    away = math.radians(longitude - middle)
    convergence = math.degrees(math.atan(math.tan(away) * math.sin(math.radians(latitude))))

    place, north = grid.place([latitude], [longitude])

    assert north[0] == pytest.approx(-convergence, abs=2e-3)  # east of the middle, true north is to the left
    assert grid.degrees(place)[2][0] == pytest.approx(north[0], abs=1e-9)


def test_differences_of_positions_are_those_on_the_earth():
    pytest.importorskip("pyproj")
    step = 1e-4  # degrees
    found = place_all(
        [degrees(46.84, -91.99), degrees(46.84 + step, -91.99), degrees(46.84, -91.99 + step)], None, None
    )

    a, e2, phi = 6378137.0, 0.00669437999014, math.radians(46.84)
    w = math.sqrt(1.0 - e2 * math.sin(phi) ** 2)
    north, east = (a * (1.0 - e2) / w**3, a / w * math.cos(phi))
    lengths = np.linalg.norm(found.position[1:] - found.position[0], axis=1)
    stretched = 1.0 + 200.0 / 6.371e6  # of distances at the height of the photographs
    assert lengths == pytest.approx([stretched * math.radians(step) * part for part in (north, east)], rel=2e-6)
    assert found.scale == pytest.approx(0.9996 * (1.0 + (76.6 / 6371.0) ** 2 / 2.0) / stretched, rel=2e-6)
    assert found.crs == "EPSG:32615"
    assert all(float(part).is_integer() for part in found.origin)
    assert np.abs(found.position[:, :2]).max() < 20.0
    assert found.position[:, 2].tolist() == [200.0] * 3


def test_points_keep_every_digit_through_the_origin():
    pytest.importorskip("pyproj")
    points = [point(576700.123456, 5188120.654321), point(576760.5, 5188180.25)]

    found = place_all(points, "EPSG:32615", None)

    place = Georeference("EPSG:32615", found.origin, scale=found.scale)
    back = place.coordinates(torch.from_numpy(found.position)).numpy()
    assert back[:, :2] == pytest.approx(np.array([one.point for one in points]), abs=1e-9)
    assert found.sigma.tolist() == [[0.02, 0.02, 0.03]] * 2
    assert found.vertical is STATED


def test_points_without_a_system_stay_as_they_are():
    found = place_all([point(1.0, 2.0), point(3.0, 4.0)], None, None)

    assert (found.crs, found.origin, found.north_deg.tolist()) == (None, (0.0, 0.0, 0.0), [0.0, 0.0])
    assert found.position.tolist() == [[1.0, 2.0, 12.0], [3.0, 4.0, 12.0]]


@pytest.mark.parametrize(
    ("altitudes", "wanted", "level", "without"),
    [
        ([FIRST, FIRST], None, S, ()),
        ([FIRST, FIRST], T, T, ()),
        ([{E: 230.0, T: 40.0}, {E: 230.0, T: 40.0}, FIRST], None, E, (2,)),
        ([{E: 230.0, T: 40.0}, FIRST, FIRST], None, S, (0,)),
        ([{E: 230.0, T: 40.0}, FIRST, FIRST], T, T, ()),
        ([{T: 40.0}, {T: 41.0}], None, T, ()),
        ([{}, FIRST, FIRST], None, S, (0,)),
        ([FIRST, FIRST], E, E, (0, 1)),
    ],
)
def test_altitudes_are_counted_from_one_level(altitudes, wanted, level, without):
    pytest.importorskip("pyproj")

    found = place_all([degrees(46.84, -91.99, of) for of in altitudes], None, wanted)

    assert tuple(np.flatnonzero(~found.known)) == without
    assert set(found.lacking) == set(without)
    assert found.vertical is level
    assert found.position[found.known, 2].tolist() == [of[level] for i, of in enumerate(altitudes) if i not in without]


def test_photographs_without_a_position_are_told_and_the_others_stay():
    pytest.importorskip("pyproj")

    found = place_all([degrees(46.84, -91.99), None, degrees(46.8401, -91.99)], None, None)

    assert found.known.tolist() == [True, False, True]
    assert found.lacking == {1: "no position"}
    assert found.north_deg[1] == pytest.approx(found.north_deg[[0, 2]].mean())


def test_degrees_among_points_of_a_frame_of_its_own_need_a_system():
    pytest.importorskip("pyproj")
    mixed = [point(576700.0, 5188120.0, FIRST), degrees(46.8422, -91.9940)]

    alone, together = place_all(mixed, None, None), place_all(mixed, "EPSG:32615", None)

    assert "give crs" in alone.lacking[1]
    assert together.known.all()
    assert np.linalg.norm(np.diff(together.position, axis=0)) < 100.0


def test_without_pyproj_positions_are_left_out_with_what_to_install(monkeypatch):
    for module in (local_frame, placing):
        monkeypatch.setattr(module, "has_projections", lambda: False)

    found = place_all([degrees(46.84, -91.99), degrees(46.8401, -91.99)], None, None)

    assert not found.known.any()
    assert all("torchrefrac[geo]" in reason for reason in found.lacking.values())


@pytest.mark.parametrize(
    ("crs", "sentence"),
    [
        ("EPSG:999999", "is not known to pyproj"),
        ("pond", "is not known to pyproj"),
        ("EPSG:4326", "has no axes in metres"),
        ("EPSG:2263", "has no axes in metres"),  # feet
    ],
)
def test_a_system_that_has_no_metres_is_refused(crs, sentence):
    pytest.importorskip("pyproj")
    with pytest.raises(CaptureError, match=sentence):
        Grid(crs)
