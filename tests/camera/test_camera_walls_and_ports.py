"""Cameras before walls of glass, behind ports, under water: against the path of least time, and there and back."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.optimize import root

from tests.camera.camera_scenes import (
    COUNT,
    INTERFACES,
    for_every_interface,
    for_every_refraction,
    opencv_pinhole,
    scene,
)
from tests.tolerances import assert_matches, assert_same_pixels
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import so3_exp
from torchrefrac.refraction import FlatInterface

PORTS = [name for name, interface in INTERFACES.items() if interface.moves_with_camera]
for_every_port = pytest.mark.parametrize("name", PORTS)


@for_every_interface
@pytest.mark.parametrize("place", ["ordinary", "nadir", "land"])
def test_a_pixel_shows_where_the_quickest_path_of_light_arrives_from(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    pixels, valid = camera.project(points)

    assert valid.all()
    arrival = torch.stack([_first_crossing(camera[i], points[i]) for i in range(COUNT)])
    assert_same_pixels(pixels, opencv_pinhole(camera, arrival), slack=10.0)


@for_every_interface
def test_a_point_anywhere_on_the_ray_of_a_pixel_projects_to_that_pixel(draw, lens, make_pixels, name):
    camera, pixels = scene(draw, lens, name, "ordinary")[0], make_pixels(COUNT, 1000)
    origins, directions, met = camera[:, None].cast_rays(pixels)
    points = origins + draw.power_of_ten(-3.0, 1.0, COUNT, 1000, 1) * directions

    back, valid = camera[:, None].project(points)

    assert met.sum() > 1000
    assert valid[met].all()
    assert_same_pixels(back[met], pixels[met])


def test_a_point_inside_the_glass_is_seen_as_if_the_glass_had_no_end(draw, lens, make_pixels):
    camera, pixels = scene(draw, lens, "into thick glass", "ordinary")[0], make_pixels(COUNT, 500)
    endless = replace(camera, interface=FlatInterface(layers=(1.0, 1.52), plane=camera.interface.plane))
    origins, directions, met = endless[:, None].cast_rays(pixels)
    points = origins + draw.uniform(0.0, 9.0, COUNT, 500, 1) * directions

    back, valid = camera[:, None].project(points)

    assert met.sum() > 1000
    assert valid[met].all()
    assert_same_pixels(back[met], pixels[met])
    assert_same_pixels(back[met], endless[:, None].project(points)[0][met])


@for_every_interface
def test_the_image_of_a_point_that_leaves_each_layer_makes_no_jump(draw, lens, name):
    camera, _ = scene(draw, lens, name, "ordinary")
    plane, passed = camera.plane_in_world(), torch.zeros(COUNT, dtype=torch.float64)
    normal, center = plane.normal_like(passed), camera.center_in_world
    foot = center - plane.signed_distance(center)[:, None] * normal
    across = torch.nn.functional.normalize(torch.linalg.cross(normal.expand(COUNT, 3), draw.directions(COUNT)), dim=-1)

    for thickness in (0.0, *camera.interface.thickness):
        passed = passed + thickness
        before, after = (foot + 0.05 * across - (passed + step)[:, None] * normal for step in (-1e-12, 1e-12))
        assert_same_pixels(camera.project(before)[0], camera.project(after)[0], slack=100.0)


@pytest.mark.parametrize("name", ["looking out", "looking out through glass"])
def test_beyond_the_critical_angle_rays_are_masked_and_straight(draw, lens, make_pixels, name):
    camera, pixels = scene(draw, lens, name, "ordinary")[0][:, None], make_pixels(COUNT, 1000)

    origins, directions, valid = camera.cast_rays(pixels)

    viewing = camera.view_directions(pixels)
    along = (viewing * -camera.interface.plane.normal_like(viewing)).sum(dim=-1)
    leaves = (along > 0) & ((1.0 - along.square()).sqrt() < 1.0 / 1.333)
    assert leaves.sum() > 1000
    assert (~leaves).sum() > 100
    assert torch.equal(valid, leaves)
    assert torch.equal(origins[~valid], camera.center_in_world.expand_as(origins)[~valid])
    assert_matches(directions[~valid], viewing[~valid])


@pytest.mark.parametrize("name", ["looking out", "looking out through glass"])
def test_a_diver_sees_all_that_is_above_the_water_within_the_critical_angle(draw, lens, name):
    camera, points = scene(draw, lens, name, "grazing")

    angle, valid = camera.incidence_angle(points)

    assert valid.all()
    assert (angle < np.arcsin(1.0 / 1.333)).all()
    assert (angle > np.arcsin(1.0 / 1.333) - 0.01).all()


@for_every_port
@pytest.mark.parametrize("place", ["ordinary", "nadir", "grazing", "land"])
def test_a_port_shows_what_a_wall_in_its_place_does(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    wall = _as_wall(camera)

    assert not wall.interface.moves_with_camera
    pixels, valid = camera.project(points)
    assert torch.equal(valid, wall.project(points)[1])
    assert_same_pixels(pixels, wall.project(points)[0])
    for ray, expected in zip(camera.cast_rays(pixels), wall.cast_rays(pixels), strict=True):
        torch.testing.assert_close(ray, expected, rtol=0.0, atol=1e-12)


@for_every_port
@pytest.mark.parametrize("place", ["ordinary", "grazing"])
def test_a_port_differs_from_a_wall_in_its_place_only_in_what_the_pose_does(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    port, wall = (which.project_with_jacobians(points)[1] for which in (camera, _as_wall(camera)))

    size = port.point.abs().amax()
    for block in ("point", "focal", "principal_point", "distortion", "indices", "plane_height"):
        assert_matches(getattr(port, block) / size, getattr(wall, block) / size, slack=100.0)
    assert_matches(port.center, -port.point)
    along = (wall.center - port.center) / size
    normal = camera.plane_in_world().normal_like(points)[:, None]
    assert (along.norm(dim=-1).amax(dim=-1) > 1e-5).all()
    assert_matches(along, (along * normal).sum(dim=-1, keepdim=True) * normal, slack=100.0)
    assert ((wall.rotation - port.rotation).norm(dim=-1).amax(dim=-1) > 1.0).all()


@for_every_port
def test_the_pose_moves_the_image_of_a_port_as_a_wall_that_follows_the_pose_does(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    turn = torch.zeros(COUNT, 3, dtype=torch.float64, requires_grad=True)
    center = camera.center_in_world.clone().requires_grad_()

    following = _as_wall(replace(_turned(camera, turn), center_in_world=center, check=False))
    pixels, _ = following.project(points)

    jacobians = camera.project_with_jacobians(points)[1]
    for axis in range(2):
        by_turn, by_center = torch.autograd.grad(pixels[:, axis].sum(), (turn, center), retain_graph=True)
        size = by_center.abs().amax()
        assert_matches(jacobians.rotation[:, axis] / size, by_turn / size, slack=100.0)
        assert_matches(jacobians.center[:, axis] / size, by_center / size, slack=100.0)


@for_every_port
def test_autograd_through_the_pose_of_a_port_is_right(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    def project(turn, center, point):
        return replace(_turned(camera, turn), center_in_world=center).project(point)[0]

    at = (torch.zeros(COUNT, 3, dtype=torch.float64), camera.center_in_world, points)
    assert torch.autograd.gradcheck(project, [value.clone().requires_grad_() for value in at], rtol=1e-4, atol=1e-4)


@for_every_port
def test_a_port_has_no_place_in_the_world(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    turn, shift = draw.rotations(), 100.0 * draw.normal(3)
    moved = replace(
        camera,
        cam_from_world_rotation=camera.cam_from_world_rotation @ turn.mT,
        center_in_world=camera.center_in_world @ turn.mT + shift,
    )

    pixels, valid = moved.project(points @ turn.mT + shift)

    assert valid.all()
    assert_same_pixels(pixels, camera.project(points)[0])


@for_every_refraction
def test_world_and_interface_turned_and_shifted_together_leave_the_image_as_it_is(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    turn, shift = draw.rotations(), draw.normal(3)
    plane = camera.interface.plane.in_frame(turn, -shift @ turn)
    if camera.interface.moves_with_camera:
        plane = camera.interface.plane
    moved = replace(
        camera,
        cam_from_world_rotation=camera.cam_from_world_rotation @ turn.mT,
        center_in_world=camera.center_in_world @ turn.mT + shift,
        interface=replace(camera.interface, plane=plane),
    )

    pixels, valid = moved.project(points @ turn.mT + shift)

    assert valid.all()
    assert_same_pixels(pixels, camera.project(points)[0])


@for_every_interface
def test_every_camera_of_a_batch_sees_what_it_sees_alone(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    pixels, _ = camera.project(points)

    for i in range(COUNT):
        assert_same_pixels(camera[i].project(points[i])[0], pixels[i], slack=0.01)


def _as_wall(camera):
    """The same camera with its port fixed in the world where it is now."""
    interface = replace(camera.interface, plane=camera.plane_in_world(), moves_with_camera=False)
    return RefractiveCamera(camera.intrinsics, camera.cam_from_world_rotation, camera.center_in_world, interface)


def _turned(camera, turn):
    return replace(camera, cam_from_world_rotation=so3_exp(turn) @ camera.cam_from_world_rotation)


def _first_crossing(camera, point):
    """Where the quickest path of light from one point to one camera crosses the first surface, by Fermat's principle.

    The places on all surfaces that make the optical path stationary, in coordinates of the world: nothing is reduced
    to the plane of incidence. A point on the camera's side is returned itself.
    """
    plane = camera.plane_in_world()
    normal, offset = plane.normal_like(point).numpy(), float(plane.signed_distance(torch.zeros_like(point)))
    eye, end = camera.center_in_world.numpy(), point.numpy()
    depth = -(normal @ end) - offset
    if depth <= 0.0:
        return point
    indices = [float(n) for n in camera.interface.indices]
    levels, passed = [0.0], 0.0
    for thickness in camera.interface.thickness:
        passed += float(thickness)
        levels.append(passed)
    levels = [level for level in levels if level < depth]
    tangents = np.linalg.svd(normal[None])[2][1:]  # (2, 3)
    first_foot = eye - (normal @ eye + offset) * normal
    feet = [first_foot - level * normal for level in levels]

    def crossings(places):
        return [foot + place @ tangents for foot, place in zip(feet, places.reshape(-1, 2), strict=True)]

    def slope(places):
        stops = [eye, *crossings(places), end]
        legs = [n * (b - a) / np.linalg.norm(b - a) for n, (a, b) in zip(indices, pairwise(stops), strict=False)]
        return np.concatenate([tangents @ (before - after) for before, after in pairwise(legs)])

    straight = tangents @ (end - eye)
    height = float(normal @ eye + offset)
    start = np.concatenate([straight * (height + level) / (height + depth) for level in levels])
    found = root(slope, start, tol=1e-15)
    assert np.abs(slope(found.x)).max() < 1e-11
    return torch.as_tensor(crossings(found.x)[0])
