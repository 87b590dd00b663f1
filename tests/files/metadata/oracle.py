"""Gravity and heading from angles, by turning three arrows one after the other: no matrix of the package takes part."""

import math

import numpy as np

NORTH, EAST, DOWN = np.eye(3)


def turned(vector: np.ndarray, axis: np.ndarray, angle_deg: float) -> np.ndarray:
    """A vector turned about a unit axis, right-handed (Rodrigues)."""
    angle = math.radians(angle_deg)
    along = axis * (axis @ vector)
    return along + math.cos(angle) * (vector - along) + math.sin(angle) * np.cross(axis, vector)


def camera_axes(yaw: float, pitch: float, roll: float, looks_down: bool = False) -> np.ndarray:
    """Right, down and forward of a camera, as rows in north, east, down.

    A body that faces north, level, turns about its own axes: to the right by yaw, its nose up by pitch, its right side
    down by roll. A camera looks along its nose, or straight down through its belly, the top of its image to the nose.
    """
    nose, side, belly = NORTH, EAST, DOWN
    nose, side = (turned(axis, belly, yaw) for axis in (nose, side))
    nose, belly = (turned(axis, side, pitch) for axis in (nose, belly))
    side, belly = (turned(axis, nose, roll) for axis in (side, belly))
    return np.stack((side, -nose, belly) if looks_down else (side, belly, nose))


def down_in_cam(axes: np.ndarray) -> np.ndarray:
    """How far down each axis points."""
    return axes @ DOWN


def heading_deg(axes: np.ndarray) -> float:
    """Bearing of the image's top after the shortest turn that makes the camera look straight down."""
    _, down, forward = axes
    axis, angle = np.cross(forward, DOWN), math.degrees(math.acos(np.clip(forward @ DOWN, -1.0, 1.0)))
    size = np.linalg.norm(axis)
    top = -down if size < 1e-12 else turned(-down, axis / size, angle)
    return math.degrees(math.atan2(top[1], top[0])) % 360.0
