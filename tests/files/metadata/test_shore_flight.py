"""Six photographs of a real drone: what was read with another program, and by hand from their bytes."""

import math
import re

import pytest

from torchrefrac.files.metadata.photograph import read_photograph
from torchrefrac.files.metadata.position import Vertical

# name: latitude and longitude in degrees, minutes, seconds; altitude, height above take-off, gimbal yaw
VALUES = {
    "DJI_0030.JPG": ((46, 50, 32.2138), (91, 59, 38.703), 198.61, 40.1, 44.2),
    "DJI_0031.JPG": ((46, 50, 32.5373), (91, 59, 38.2328), 198.71, 40.2, 41.4),
    "DJI_0032.JPG": ((46, 50, 32.8504), (91, 59, 37.7855), 198.61, 40.1, 42.0),
    "DJI_0033.JPG": ((46, 50, 33.1557), (91, 59, 37.3297), 198.61, 40.1, 42.9),
    "DJI_0034.JPG": ((46, 50, 33.4654), (91, 59, 36.8832), 198.51, 40.0, 44.7),
    "DJI_0035.JPG": ((46, 50, 33.7796), (91, 59, 36.4391), 198.51, 40.0, 45.3),
}


@pytest.fixture(scope="module")
def texts():
    """`texts(path, name)`: an attribute of XMP, straight from the bytes of a file."""

    def read(path, name):
        found = re.search(rb'drone-dji:%s="([-+\d.]+)"' % name.encode(), path.read_bytes())
        assert found is not None
        return float(found[1])

    return read


@pytest.mark.parametrize("name", VALUES)
def test_what_is_read_is_what_the_file_holds(shared_data, texts, name):
    path = shared_data("shore_flight") / "images" / name
    latitude, longitude, altitude, above, yaw = VALUES[name]

    found = read_photograph(path)

    assert found.size == (4000, 2250)
    assert found.body == ("DJI", "FC300S", "")
    assert found.fix.latitude == pytest.approx(latitude[0] + latitude[1] / 60 + latitude[2] / 3600, abs=1e-8)
    assert -found.fix.longitude == pytest.approx(longitude[0] + longitude[1] / 60 + longitude[2] / 3600, abs=1e-8)
    assert found.fix.altitudes == {Vertical.SEA_LEVEL: altitude, Vertical.TAKE_OFF: above}
    assert (texts(path, "AbsoluteAltitude"), texts(path, "RelativeAltitude")) == (altitude, above)
    assert texts(path, "GimbalYawDegree") == yaw
    pitch, roll = (math.radians(texts(path, f"Gimbal{angle}Degree")) for angle in ("Pitch", "Roll"))
    down = (math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch), -math.sin(pitch))
    assert found.attitude.down_in_cam == pytest.approx(down, abs=1e-9)
    assert found.attitude.heading_deg == pytest.approx(yaw, abs=1e-6)
    assert found.lens.focal[0] == pytest.approx(3.61 / 6.31 * 4000, rel=1e-6)
    assert found.lens.sigma == 0.05
    assert not found.is_past_nadir
