"""Interfaces of every kind, and cameras that look through them."""

import cv2
import numpy as np
import pytest
import torch

from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface

COUNT = 6  # cameras of a scene

TILTED = Plane((0.1, -0.2, 1.0), 0.05)
WALL = Plane((1.0, 0.0, 0.0), 0.3)  # upright: the camera stands at x > 0.3
SPREAD = torch.linspace(-0.2, 0.2, COUNT, dtype=torch.float64)

INTERFACES = {
    "water": FlatInterface(1.333),
    "tilted water": FlatInterface(1.333, plane=TILTED),
    "glass wall": FlatInterface.glass_wall(WALL, 0.1),
    "slab": FlatInterface.slab(TILTED, 0.2),
    "looking out": FlatInterface(layers=(1.333, 1.0), plane=WALL),
    "looking out through glass": FlatInterface(layers=(1.333, 1.52, 1.0), thickness=(0.1,), plane=TILTED),
    "into thick glass": FlatInterface(layers=(1.0, 1.52, 1.333), thickness=(99.0,), plane=TILTED),
    "port": FlatInterface.flat_port(0.05, 0.01),
    "tilted port": FlatInterface.glass_wall(Plane((0.1, 0.05, -1.0), -0.1), 0.02, moves_with_camera=True),
    "each camera its own": FlatInterface(
        layers=(1.25 + SPREAD, 1.4 - SPREAD, 1.3 - 0.5 * SPREAD),
        thickness=(0.3 + SPREAD,),
        plane=Plane(torch.stack((SPREAD, 0.1 - 2.0 * SPREAD, torch.ones_like(SPREAD)), dim=-1), 2.0 * SPREAD),
    ),
    "no refraction": FlatInterface(1.0),
    "layers of one index": FlatInterface(layers=(1.2, 1.2, 1.2), thickness=(0.1,), plane=TILTED),
}
REFRACTING = [name for name, interface in INTERFACES.items() if interface.refracts().all()]
PLACES = ("ordinary", "nadir", "grazing", "land")

for_every_interface = pytest.mark.parametrize("name", INTERFACES)
for_every_refraction = pytest.mark.parametrize("name", REFRACTING)
at_every_place = pytest.mark.parametrize("place", PLACES)


def scene(draw, lens, name, place):
    """COUNT cameras behind the interface of that name, and a point (COUNT, 3) that each of them looks at.

    The points stand straight behind the surface ("nadir"), up to 27 degrees off that ("ordinary"), up to 88 degrees or,
    through a port, 42 degrees, which its air makes nearly 65 ("grazing"), or half-way to it ("land").
    """
    interface = INTERFACES[name]
    if interface.moves_with_camera:
        rotation, center = draw.rotations(COUNT), draw.normal(COUNT, 3)
        height = interface.plane.signed_distance(torch.zeros(COUNT, 3, dtype=torch.float64))
        away = -interface.plane.normal_like(center) @ rotation
    else:
        center, height = draw.normal(COUNT, 3), draw.uniform(1.0, 2.0, COUNT)
        away = -interface.plane.normal_like(center).expand(COUNT, 3)
        center = center - (height - interface.plane.signed_distance(center))[:, None] * away
    depth = -0.5 * height if place == "land" else draw.uniform(0.2, 2.0, COUNT)
    steepest = 0.9 if interface.moves_with_camera else 30.0
    slope = {"nadir": 0.0, "grazing": steepest}.get(place, 0.5) * draw.uniform(0.9, 1.0, COUNT)
    sideways = torch.nn.functional.normalize(torch.linalg.cross(away, draw.directions(COUNT)), dim=-1)
    points = center + (height + depth)[:, None] * (away + slope[:, None] * sideways)
    if not interface.moves_with_camera:
        rotation = looking_along(points - center, draw)
    return RefractiveCamera(lens, rotation, center, interface), points


def looking_along(direction, draw, off=0.3):
    """cam_from_world rotations (*B, 3, 3) of cameras that look about along `direction` (*B, 3), rolled in any way."""
    shape = direction.shape[:-1]
    forward = torch.nn.functional.normalize(direction, dim=-1)
    forward = torch.nn.functional.normalize(forward + off * draw.directions(*shape), dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, draw.directions(*shape)), dim=-1)
    return torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)


def opencv_pinhole(camera, points):
    """Straight projection (N, 2) of points (N, 3), one for each of N cameras, by OpenCV.

    There the first pixel has its centre at (0, 0) instead of (0.5, 0.5).
    """
    lens = camera.intrinsics
    (fx, fy), (cx, cy) = lens.focal.tolist(), lens.principal_point.tolist()
    matrix = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    pixels = []
    for rotation, center, point in zip(
        camera.cam_from_world_rotation.numpy(), camera.center_in_world.numpy(), points.numpy(), strict=True
    ):
        turn, shift = cv2.Rodrigues(rotation)[0], -rotation @ center
        pixels.append(cv2.projectPoints(point[None], turn, shift, matrix, lens.distortion.numpy())[0][0, 0] + 0.5)
    return torch.as_tensor(np.stack(pixels))
