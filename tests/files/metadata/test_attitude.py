"""From angles to gravity and heading: cases that can be seen with a hand, and a camera that is turned step by step."""

import math

import numpy as np
import pytest

from tests.files.metadata import oracle
from torchrefrac.files.metadata.attitude import Attitude, Mount, as_stored

COS, SIN = math.cos(math.radians(80.0)), math.sin(math.radians(80.0))
HALF = math.sqrt(0.5)


def angle_between(a: float, b: float) -> float:
    return abs((a - b + 180.0) % 360.0 - 180.0)


@pytest.mark.parametrize(
    ("yaw", "pitch", "roll", "down", "heading"),
    [
        (0.0, -90.0, 0.0, (0.0, 0.0, 1.0), 0.0),  # straight down, the top of the image to the north
        (90.0, -90.0, 0.0, (0.0, 0.0, 1.0), 90.0),
        (30.0, -45.0, 0.0, (0.0, HALF, HALF), 30.0),  # gravity to the lower edge
        (30.0, -80.0, 0.0, (0.0, COS, SIN), 30.0),
        (0.0, 0.0, 10.0, (math.sin(math.radians(10.0)), math.cos(math.radians(10.0)), 0.0), None),  # right side down
        (0.0, -90.0, 20.0, (0.0, 0.0, 1.0), 20.0),  # turned clockwise about the line of sight
        # Ten degrees past straight down with the top still to the north: gravity to the upper edge. The gimbal says
        # that it faces south, 80 degrees down, upside down.
        (180.0, -80.0, 180.0, (0.0, -COS, SIN), 0.0),
        (0.0, -100.0, 0.0, (0.0, -COS, SIN), 0.0),
        (180.0, -90.0, 180.0, (0.0, 0.0, 1.0), 0.0),
    ],
)
def test_what_a_hand_can_see(yaw, pitch, roll, down, heading):
    found = Attitude.of_angles(yaw, pitch, roll, 0.5, "")

    assert found.down_in_cam == pytest.approx(down, abs=1e-12)
    if heading is not None:
        assert angle_between(found.heading_deg, heading) < 1e-9


@pytest.mark.parametrize(
    ("pitch", "roll", "down"),
    [
        (0.0, 0.0, (0.0, 0.0, 1.0)),
        (10.0, 0.0, (0.0, math.sin(math.radians(10.0)), math.cos(math.radians(10.0)))),  # nose up: it looks ahead
        (0.0, 10.0, (math.sin(math.radians(10.0)), 0.0, math.cos(math.radians(10.0)))),  # right wing down
    ],
)
def test_a_camera_that_looks_through_the_floor_of_an_aircraft(pitch, roll, down):
    found = Attitude.of_angles(70.0, pitch, roll, 0.5, "", Mount.DOWN)

    assert found.down_in_cam == pytest.approx(down, abs=1e-12)
    assert angle_between(found.heading_deg, 70.0) < 5.0


@pytest.mark.parametrize("mount", Mount)
def test_any_angles_are_those_of_a_body_turned_about_its_own_axes(mount):
    random = np.random.default_rng(7)
    for yaw, pitch, roll in zip(
        random.uniform(-180, 180, 60), random.uniform(-89, 40, 60), random.uniform(-180, 180, 60), strict=True
    ):
        axes = oracle.camera_axes(yaw, pitch, roll, looks_down=mount is Mount.DOWN)
        found = Attitude.of_angles(yaw, pitch, roll, 0.5, "", mount)

        assert found.down_in_cam == pytest.approx(oracle.down_in_cam(axes), abs=1e-12)
        assert angle_between(found.heading_deg, oracle.heading_deg(axes)) < 1e-6


def test_the_half_turn_is_that_of_the_image():
    axes = oracle.camera_axes(50.0, -70.0, 8.0)
    upside_down = np.stack((-axes[0], -axes[1], axes[2]))

    found = Attitude.of_angles(50.0, -70.0, 8.0, 0.5, "").half_turned

    assert found.down_in_cam == pytest.approx(oracle.down_in_cam(upside_down))
    assert angle_between(found.heading_deg, oracle.heading_deg(upside_down)) < 1e-9


@pytest.mark.parametrize(
    ("orientation", "transpose"), [(1, None), (3, 2), (6, 1), (8, 3)]
)  # quarter turns, counter-clockwise, from the image as shown to the one stored
def test_gravity_goes_with_the_pixels_as_stored(orientation, transpose):
    shown = np.zeros((5, 7))
    shown[4, 5] = 1.0  # below and right of the middle
    stored = np.rot90(shown, transpose or 0)
    (row,), (column,) = np.nonzero(stored)
    middle = (np.array(stored.shape) - 1) / 2

    found = as_stored((2.0, 2.0, 0.0), orientation)

    assert found == (column - middle[1], row - middle[0], 0.0)


def test_a_mirrored_image_has_no_gravity():
    assert as_stored((0.0, 1.0, 0.0), 2) is None
