"""Where photographs were taken: places, what altitudes count from, standard deviations."""

import pytest

from tests.files.metadata.made_photographs import gps, packet, write_photograph
from torchrefrac.files.metadata.photograph import read_photograph
from torchrefrac.files.metadata.position import Vertical

E, S, T = Vertical.ELLIPSOID, Vertical.SEA_LEVEL, Vertical.TAKE_OFF
RTK = {"drone_dji__RtkStdLon": "0.010", "drone_dji__RtkStdLat": "0.014", "drone_dji__RtkStdHgt": "0.020"}
PLACE = {"drone_dji__GpsLatitude": "+46.50001", "drone_dji__GpsLongitude": "-91.20002"}
UP = {"drone_dji__AbsoluteAltitude": "+230.10", "drone_dji__RelativeAltitude": "+40.00"}
ROUGH = (1.5, 3.0)


@pytest.mark.parametrize(
    ("tags", "xmp", "place", "altitudes", "sigma"),
    [
        (gps(46.5, -91.2, 200.5), {}, (46.5, -91.2), {S: 200.5}, ROUGH),
        (gps(-46.5, 91.2, -3.25), {}, (-46.5, 91.2), {S: -3.25}, ROUGH),
        (gps(46.5, -91.2), {}, (46.5, -91.2), {}, ROUGH),
        (gps(46.5, -91.2, 200_000.0), {}, (46.5, -91.2), {}, ROUGH),
        (gps(46.5, -91.2, 200.5, GPSHPositioningError=(6, 1)), {}, (46.5, -91.2), {S: 200.5}, (6.0, 12.0)),
        (gps(46.5, -91.2, 200.5), {**PLACE, **UP}, (46.50001, -91.20002), {S: 230.1, T: 40.0}, ROUGH),
        ({}, {**PLACE, **UP}, (46.50001, -91.20002), {S: 230.1, T: 40.0}, ROUGH),
        ({}, {**PLACE, **UP, **RTK, "drone_dji__RtkFlag": "50"}, (46.50001, -91.20002), {E: 230.1, T: 40.0},
         (0.021, 0.03)),
        ({}, {**PLACE, **UP, **RTK, "drone_dji__RtkFlag": "34"}, (46.50001, -91.20002), {E: 230.1, T: 40.0},
         (0.021, 0.03)),
        ({}, {**PLACE, **UP, **RTK, "drone_dji__RtkFlag": "16"}, (46.50001, -91.20002), {S: 230.1, T: 40.0}, ROUGH),
        ({}, {**PLACE, **UP, **RTK, "drone_dji__RtkFlag": "0"}, (46.50001, -91.20002), {S: 230.1, T: 40.0}, ROUGH),
        # A drone that says only how high it is above the place of its take-off.
        (gps(46.5, -91.2, 200.5), {"drone_dji__RelativeAltitude": "40"}, (46.5, -91.2), {S: 200.5, T: 40.0}, ROUGH),
        # As it was once misspelt, and as others call it.
        ({}, {"drone__GpsLatitude": "46.5", "drone__GpsLongtitude": "-91.2", "drone__AbsoluteAltitude": "210"},
         (46.5, -91.2), {S: 210.0}, ROUGH),
        ({}, {"drone_skydio__Latitude": "46.5", "drone_skydio__Longitude": "-91.2",
              "drone_skydio__AbsoluteAltitude": "210", "drone_skydio__GpsHorizontalAccuracy": "0.8",
              "drone_skydio__GpsVerticalAccuracy": "1.1"}, (46.5, -91.2), {E: 210.0}, (0.8, 1.1)),
        (gps(46.5, -91.2, 200.5), {"Camera__GPSXYAccuracy": "0.05", "Camera__GPSZAccuracy": "0.09"}, (46.5, -91.2),
         {S: 200.5}, (0.05, 0.09)),
        # Moved by a program that geotags: what it wrote, EXIF, is meant.
        (gps(46.7, -91.2, 200.5), {**PLACE, **UP}, (46.7, -91.2), {S: 200.5, T: 40.0}, ROUGH),
        (gps(0.0, 0.0, 200.5), {**PLACE, **UP}, (46.50001, -91.20002), {S: 230.1, T: 40.0}, ROUGH),
        (gps(46.5, -91.2, 200.5, GPSStatus="V"), {**PLACE, **UP}, (46.50001, -91.20002), {S: 230.1, T: 40.0}, ROUGH),
    ],
)  # fmt: skip
def test_a_photograph_was_taken_where_its_file_says(tmp_path, tags, xmp, place, altitudes, sigma):
    path = write_photograph(tmp_path / "a.jpg", tags, packet(**xmp) if xmp else b"")

    found = read_photograph(path).fix

    assert (found.latitude, found.longitude) == pytest.approx(place, abs=1e-8)
    assert found.altitudes == pytest.approx(altitudes)
    assert found.sigma == pytest.approx(sigma)


@pytest.mark.parametrize(
    ("tags", "xmp"),
    [
        (gps(0.0, 0.0, 0.0), {}),
        (gps(0.0, 0.0), {"drone_dji__GpsLatitude": "0.000000", "drone_dji__GpsLongitude": "0.000000"}),
        (gps(46.5, -91.2, 200.5, GPSStatus="V"), {}),
        ({**gps(46.5, -91.2), "GPSLatitude": (46, 30)}, {}),
        ({}, {"drone_dji__GpsLatitude": "146.5", "drone_dji__GpsLongitude": "-91.2"}),
        ({}, {"drone_dji__GpsLatitude": "north", "drone_dji__GpsLongitude": "-91.2"}),
    ],
)
def test_what_is_no_fix_is_no_position(tmp_path, tags, xmp):
    path = write_photograph(tmp_path / "a.jpg", tags, packet(**xmp) if xmp else b"")

    assert read_photograph(path).fix is None
