"""Photographs past straight down: whether firmware turned their pixels is seen by comparing them with neighbours."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from torchrefrac.files.metadata.attitude import Attitude
from torchrefrac.files.metadata.half_turns import with_right_halves
from torchrefrac.files.metadata.kinds import Kind
from torchrefrac.files.metadata.lens import centered
from torchrefrac.files.metadata.photograph import Photograph

SIZE = (320, 240)


@pytest.fixture(scope="module")
def ground():
    """From above, north up."""
    random = np.random.default_rng(5)
    image = sum(40.0 * size * cv2.GaussianBlur(random.normal(size=(700, 700)), (0, 0), size) for size in (1, 2, 4, 8))
    return (128 + image).clip(0, 255).astype(np.uint8)


def _photograph(path, ground, heading, shift, yaw, pitch, roll, is_turned=False):
    """One that shows the ground around the middle with its top towards `heading`."""
    turn = cv2.getRotationMatrix2D((350.0 + shift, 350.0), heading, 1.0)  # counter-clockwise, as OpenCV counts
    seen = cv2.warpAffine(ground, turn, ground.shape)
    top, left = 350 - SIZE[1] // 2, 350 + shift - SIZE[0] // 2
    seen = seen[top : top + SIZE[1], left : left + SIZE[0]]
    cv2.imwrite(str(path), cv2.rotate(seen, cv2.ROTATE_180) if is_turned else seen)
    attitude = Attitude.of_angles(yaw, pitch, roll, 0.5, "gimbal")
    body, lens = ("DJI", "M3E", ""), centered(300.0, *SIZE, 0.05, "EXIF")
    return Photograph(
        path, *SIZE, Kind.ORDINARY, body, 12.3, "", attitude, None, lens, has_tags=True, is_past_nadir=abs(roll) > 90.0
    )


@pytest.mark.parametrize("heading", [0.0, 70.0, 200.0])
@pytest.mark.parametrize("is_turned", [False, True], ids=["as the sensor had them", "turned upright"])
def test_neighbours_show_how_pixels_are_stored(tmp_path, ground, heading, is_turned):
    """The aircraft turns by 80 degrees, and the gimbal of the second goes four degrees past straight down."""
    first = _photograph(tmp_path / "0.png", ground, heading - 80.0, 0, heading - 80.0, -90.0, 0.0)
    past = _photograph(tmp_path / "1.png", ground, heading, 30, heading + 180.0, -86.0, 180.0, is_turned)

    (_, found), notes = with_right_halves([first, past])

    true = Attitude.of_angles(heading, -94.0, 0.0, 0.5, "gimbal")
    expected = true.half_turned if is_turned else true
    assert found.attitude.down_in_cam == pytest.approx(expected.down_in_cam, abs=1e-9)
    assert (found.attitude.heading_deg - expected.heading_deg + 180.0) % 360.0 == pytest.approx(180.0)
    assert len(notes) == is_turned


def test_without_a_neighbour_that_shows_the_same_it_is_taken_as_told(tmp_path, ground):
    first = _photograph(tmp_path / "0.png", ground[::-1].copy(), 0.0, 0, 0.0, -90.0, 0.0)
    past = _photograph(tmp_path / "1.png", ground, 0.0, 0, 180.0, -86.0, 180.0)

    (_, found), (note,) = with_right_halves([first, past])

    assert found == past
    assert "no neighbour shows which way up it is stored" in note
    assert with_right_halves([past, replace(first, attitude=None)])[0] == [past, replace(first, attitude=None)]
