"""Rays that are bent once: there and back through the projection, and against planes."""

from dataclasses import replace

import pytest
import torch

from tests.tolerances import assert_matches, assert_same_pixels
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.dense.rays import PixelRays
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface

COUNT = 400
INTERFACES = {
    "water": FlatInterface(1.333),
    "tilted water": FlatInterface(1.333, plane=Plane((0.1, -0.2, 1.0), 0.5)),
    "a wall": FlatInterface(1.333, plane=Plane((1.0, 0.0, 0.1), 3.0)),
    "no refraction": FlatInterface(1.0),
    "looking out of the water": FlatInterface(layers=(1.333, 1.0)),
    "moving with the camera": FlatInterface(1.333, plane=Plane((0.1, 0.05, -1.0), -2.0), moves_with_camera=True),
    "each camera its own": FlatInterface(
        torch.linspace(1.2, 1.5, COUNT, dtype=torch.float64),
        plane=Plane(offset=torch.linspace(-1.0, 1.0, COUNT, dtype=torch.float64)),
    ),
}
for_every_interface = pytest.mark.parametrize("name", INTERFACES)


def _cameras(draw, name):
    """COUNT cameras 10 to 20 from the interface, that look towards it; and pixels (COUNT, 2)."""
    interface, center = INTERFACES[name], 5.0 * draw.normal(COUNT, 3)
    normal = interface.plane.normal_like(center).expand(COUNT, 3)
    if not interface.moves_with_camera:
        center = center + (draw.uniform(10.0, 20.0, COUNT) - interface.plane.signed_distance(center))[:, None] * normal
        forward = torch.nn.functional.normalize(0.3 * draw.directions(COUNT) - normal, dim=-1)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, draw.directions(COUNT)), dim=-1)
        rotation = torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
    else:
        rotation = draw.rotations(COUNT)
    lens = Intrinsics.create(640, 480, 700.0, distortion=(-0.1, 0.02, 0.001, -0.001, 0.0))
    pixels = torch.stack((draw.uniform(0.0, 640.0, COUNT), draw.uniform(0.0, 480.0, COUNT)), dim=-1)
    return RefractiveCamera(lens, rotation, center, interface), pixels


@for_every_interface
@pytest.mark.parametrize("side", ["before", "after"])
def test_every_point_of_a_ray_is_seen_in_its_pixel(draw, name, side):
    camera, pixels = _cameras(draw, name)
    rays = PixelRays.cast(camera, pixels)
    to_camera = (rays.origin - camera.center_in_world).norm(dim=-1)
    distance = draw.power_of_ten(-3.0, 2.0, COUNT) if side == "after" else -draw.uniform(0.001, 0.9, COUNT) * to_camera

    back, valid = camera.project(rays.at(distance))

    assert valid.all()
    assert_same_pixels(back, pixels, slack=10.0)


def test_behind_a_wall_of_glass_the_points_in_the_water_are_seen_in_their_pixel(draw):
    camera, pixels = _cameras(draw, "a wall")
    camera = replace(camera, interface=FlatInterface.glass_wall(INTERFACES["a wall"].plane, 0.2))

    back, valid = camera.project(PixelRays.cast(camera, pixels).at(draw.power_of_ten(-3.0, 2.0, COUNT)))

    assert valid.all()
    assert_same_pixels(back, pixels, slack=10.0)


@for_every_interface
def test_a_ray_begins_on_the_water_at_distance_zero_and_makes_no_jump_there(draw, name):
    camera, pixels = _cameras(draw, name)
    rays = PixelRays.cast(camera, pixels)
    zero = torch.zeros(COUNT, dtype=torch.float64)

    assert torch.equal(rays.at(zero), rays.origin)
    assert_matches(camera.plane_in_world().signed_distance(rays.origin), zero, slack=100.0)
    torch.testing.assert_close(rays.at(zero - 1e-9), rays.at(zero + 1e-9), rtol=0.0, atol=2.1e-9)


@for_every_interface
def test_the_ray_comes_from_the_centre_and_obeys_snell(draw, name):
    camera, pixels = _cameras(draw, name)
    rays = PixelRays.cast(camera, pixels)
    normal = camera.plane_in_world().normal_like(rays.origin).expand(COUNT, 3)

    way = rays.origin - camera.center_in_world
    assert_matches(way / way.norm(dim=-1, keepdim=True), rays.before, slack=10.0)
    first, last = camera.interface.indices
    sines = [torch.linalg.cross(normal, direction) for direction in (rays.before, rays.after)]
    assert_matches(first * sines[0], torch.as_tensor(last, dtype=torch.float64).reshape(-1, 1) * sines[1], slack=10.0)


@for_every_interface
def test_the_direction_is_the_derivative_of_the_point(draw, name):
    camera, pixels = _cameras(draw, name)
    rays, distance = PixelRays.cast(camera, pixels), draw.uniform(-3.0, 3.0, COUNT)

    direction = rays.direction_at(distance)

    differences = (rays.at(distance + 1e-4) - rays.at(distance - 1e-4)) / 2e-4
    torch.testing.assert_close(direction, differences, rtol=0.0, atol=1e-9)


@for_every_interface
def test_a_plane_is_met_where_it_passes_through_the_ray_on_either_side_of_the_water(draw, name):
    camera, pixels = _cameras(draw, name)
    rays, distance = PixelRays.cast(camera, pixels), draw.uniform(-9.0, 9.0, COUNT)
    on_ray = rays.at(distance)
    normal = torch.nn.functional.normalize(0.5 * draw.directions(COUNT) - rays.before - rays.after, dim=-1)
    aside = torch.linalg.cross(normal, draw.directions(COUNT))

    assert_matches(rays.meet(on_ray + aside, normal), distance, slack=100.0)
    assert_matches(rays.meet(on_ray + aside, -3.0 * normal), distance, slack=100.0)


@for_every_interface
def test_distances_of_points_on_a_ray_are_those_that_they_were_made_at(draw, name):
    camera, pixels = _cameras(draw, name)
    rays, distance = PixelRays.cast(camera, pixels), draw.uniform(-9.0, 9.0, COUNT)

    assert_matches(rays.distance_of(rays.at(distance)), distance, slack=100.0)


@for_every_interface
def test_the_distance_of_any_point_is_that_of_the_nearest_point_of_the_ray(draw, name):
    camera, pixels = _cameras(draw, name)
    rays, distance = PixelRays.cast(camera, pixels), draw.uniform(-9.0, 9.0, COUNT)
    points = rays.at(distance) + draw.normal(COUNT, 3)
    along = torch.linspace(-20.0, 20.0, 2001, dtype=torch.float64)
    apart = (rays[:, None].at(along.expand(COUNT, -1)) - points[:, None]).norm(dim=-1)

    nearest = (rays.at(rays.distance_of(points)) - points).norm(dim=-1)

    assert (nearest <= apart.amin(dim=1) + 1e-9).all()


def test_a_ray_that_never_meets_the_water_is_straight_and_starts_at_the_centre():
    up = torch.diag(torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64))
    camera = RefractiveCamera(
        Intrinsics.create(64, 48, 70.0), up, torch.tensor((1.0, 2.0, 3.0)).double(), FlatInterface(1.333)
    )

    rays = PixelRays.cast(camera, torch.tensor([(32.0, 24.0)]).double())

    assert rays.origin.tolist() == [[1.0, 2.0, 3.0]]
    assert rays.before.tolist() == rays.after.tolist() == [[0.0, 0.0, 1.0]]
    assert rays.at(torch.tensor([5.0]).double()).tolist() == [[1.0, 2.0, 8.0]]
    assert rays.meet(torch.tensor((0.0, 0.0, 10.0)).double(), torch.tensor((0.0, 0.0, 1.0)).double()).tolist() == [7.0]
