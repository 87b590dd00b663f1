"""What a camera cannot see is masked, and finite together with its gradients."""

from dataclasses import replace

import pytest
import torch

from tests.camera.camera_scenes import (
    COUNT,
    INTERFACES,
    REFRACTING,
    WALL,
    for_every_interface,
    for_every_refraction,
    scene,
)
from tests.tolerances import assert_same_pixels
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.refraction import FlatInterface

FIXED = [name for name in REFRACTING if not INTERFACES[name].moves_with_camera]
for_every_fixed_interface = pytest.mark.parametrize("name", FIXED)


@for_every_interface
@pytest.mark.parametrize("place", ["ordinary", "nadir", "land"])
def test_points_behind_the_camera_are_masked_and_stay_finite(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)
    behind = 2.0 * camera.center_in_world - points

    pixels, valid = camera.project(behind)

    assert not valid.any()
    assert pixels.isfinite().all()


@for_every_interface
def test_the_centre_of_the_camera_itself_is_masked_and_finite(draw, lens, name):
    camera, _ = scene(draw, lens, name, "ordinary")

    pixels, valid = camera.project(camera.center_in_world)

    assert not valid.any()
    assert pixels.isfinite().all()


@for_every_fixed_interface
def test_a_camera_on_the_wrong_side_is_masked_and_sees_straight(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    shift = -50.0 * camera.interface.plane.normal_like(points)
    sunk = replace(camera, center_in_world=camera.center_in_world + shift, check=False)

    pixels, valid = sunk.project(points + shift)

    assert not valid.any()
    assert_same_pixels(pixels, camera.as_pinhole().project(points)[0])
    assert not sunk.cast_rays(pixels)[2].any()
    for measure in (sunk.apparent_points, sunk.apparent_depth, sunk.incidence_angle, sunk.refraction_shift):
        value, valid = measure(points + shift)
        assert not valid.any()
        assert value.isfinite().all()


@for_every_fixed_interface
def test_a_camera_on_the_wrong_side_is_refused_unless_the_check_is_left_out(draw, lens, name):
    camera, _ = scene(draw, lens, name, "ordinary")
    center = camera.center_in_world.clone()
    center[3] -= 5.0 * camera.interface.plane.normal_like(center).expand(COUNT, 3)[3]

    with pytest.raises(ValueError, match=r"^center_in_world is \S+ behind the interface somewhere"):
        replace(camera, center_in_world=center)
    assert replace(camera, center_in_world=center, check=False).shape == (COUNT,)


@pytest.mark.parametrize("name", ["no refraction", "layers of one index"])
def test_without_refraction_a_camera_may_stand_on_either_side(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    shift = -50.0 * camera.interface.plane.normal_like(points)

    pixels, valid = replace(camera, center_in_world=camera.center_in_world + shift).project(points + shift)

    assert valid.all()
    assert_same_pixels(pixels, camera.project(points)[0])


@for_every_interface
def test_land_and_water_in_one_call_are_what_they_are_alone(draw, lens, name):
    camera, wet = scene(draw, lens, name, "ordinary")
    foot = camera.center_in_world + 0.3 * (wet - camera.center_in_world)
    dry = torch.where((camera.plane_in_world().signed_distance(foot) > 0)[:, None], foot, camera.center_in_world)

    pixels, valid = camera.project(torch.stack((wet, dry, wet)))

    for i, points in enumerate((wet, dry, wet)):
        expected, seen = camera.project(points)
        assert torch.equal(pixels[i], expected)
        assert torch.equal(valid[i], seen)
    straight, visible = camera.as_pinhole().project(dry)
    assert torch.equal(visible, valid[1])
    assert_same_pixels(pixels[1][visible], straight[visible])


@for_every_interface
def test_beyond_only_masks_what_stands_on_the_cameras_side(draw, lens, name):
    camera, wet = scene(draw, lens, name, "ordinary")
    dry = scene(draw, lens, name, "land")[0].center_in_world
    points = torch.cat((wet, dry))

    pixels, valid = camera[:, None].project(points, beyond_only=True)

    everything, visible = camera[:, None].project(points)
    behind_the_surface = camera[:, None].plane_in_world().signed_distance(points) < 0
    assert torch.equal(pixels, everything)
    assert torch.equal(valid, visible & behind_the_surface)
    assert valid[:, :COUNT].any()


def test_a_point_on_the_surface_itself_is_not_beyond_it(lens):
    camera = _above_water(lens)
    points = torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.2, -1e-9], [0.1, 0.2, 1e-9]], dtype=torch.float64)

    assert camera.project(points)[1].tolist() == [True, True, True]
    assert camera.project(points, beyond_only=True)[1].tolist() == [False, True, False]


def test_inside_image_masks_what_lies_outside_and_nothing_else(draw, lens):
    camera = _above_water(Intrinsics.create(640, 480, 500.0))
    points = torch.cat((draw.uniform(-3.0, 3.0, 500, 2), draw.uniform(-2.0, 1.0, 500, 1)), dim=-1)

    pixels, valid = camera.project(points, inside_image=True)

    everything, visible = camera.project(points)
    inside = ((pixels >= 0.0) & (pixels[..., :1] <= 640.0) & (pixels[..., 1:] <= 480.0)).all(dim=-1)
    assert torch.equal(pixels, everything)
    assert torch.equal(valid, visible & inside)
    assert 50 < valid.sum() < 450


def test_the_masks_add_up(draw, lens):
    camera = _above_water(lens)
    points = torch.cat((draw.uniform(-3.0, 3.0, 500, 2), draw.uniform(-2.0, 3.0, 500, 1)), dim=-1)

    _, valid = camera.project(points, inside_image=True, beyond_only=True)

    each = [camera.project(points, inside_image=True)[1], camera.project(points, beyond_only=True)[1]]
    assert torch.equal(valid, each[0] & each[1])
    assert (each[0] != each[1]).any()


def test_every_image_has_its_own_size_of_mask(draw, lens):
    cameras = _above_water(lens, COUNT)
    points = draw.uniform(-1.0, 0.0, 5, 3)

    _, valid = cameras[:, None].project(points, inside_image=True, beyond_only=True)

    assert valid.shape == (COUNT, 5)


def test_a_ray_that_does_not_meet_the_wall_is_masked_and_straight(draw, lens, make_pixels):
    center = torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64)
    camera = replace(_above_water(lens), center_in_world=center, interface=FlatInterface.glass_wall(WALL, 0.1))
    pixels = make_pixels(500)

    origins, directions, valid = camera.cast_rays(pixels)

    viewing = camera.view_directions(pixels)
    assert torch.equal(valid, viewing[:, 0] < 0)
    assert 100 < valid.sum() < 400
    assert torch.equal(origins[~valid], camera.center_in_world.expand_as(origins)[~valid])
    torch.testing.assert_close(directions[~valid], viewing[~valid], rtol=0.0, atol=1e-15)


@for_every_refraction
def test_gradients_are_finite_where_nothing_is_seen_and_right_beside_it(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    points[0] = 2.0 * camera.center_in_world[0] - points[0]  # behind the camera
    points[1] = camera.center_in_world[1]
    center = camera.center_in_world.clone()
    if not camera.interface.moves_with_camera:
        center[2] = points[2] - 0.1 * camera.interface.plane.normal_like(points).expand(COUNT, 3)[2]  # wrong side
    inputs = [value.clone().requires_grad_() for value in (camera.cam_from_world_rotation, center, points)]

    rotation, middle, scattered = inputs
    seen = RefractiveCamera(lens, rotation, middle, camera.interface, check=False)
    seen.project(scattered)[0].sum().backward()

    assert all(value.grad.isfinite().all() for value in inputs)
    by_point = camera.project_with_jacobians(points)[1].point.sum(dim=-2)
    torch.testing.assert_close(scattered.grad[3:], by_point[3:])


@pytest.mark.parametrize("name", ["looking out", "looking out through glass"])
def test_gradients_of_rays_are_finite_beyond_the_critical_angle(draw, lens, make_pixels, name):
    camera, pixels = scene(draw, lens, name, "ordinary")[0][:, None], make_pixels(COUNT, 500).requires_grad_()
    assert not camera.cast_rays(pixels)[2].all()

    origins, directions, _ = camera.cast_rays(pixels)
    (origins.sum() + directions.sum()).backward()

    assert pixels.grad.isfinite().all()


@for_every_interface
def test_no_points_and_no_pixels_at_all_give_none(draw, lens, name):
    camera, _ = scene(draw, lens, name, "ordinary")
    nothing = torch.empty(0, COUNT, 3, dtype=torch.float64)

    pixels, jacobians, valid = camera.project_with_jacobians(nothing)

    assert camera.project(nothing)[0].shape == pixels.shape == (0, COUNT, 2)
    assert valid.shape == (0, COUNT)
    assert jacobians.rotation.shape == (0, COUNT, 2, 3)
    assert [ray.shape for ray in camera.cast_rays(pixels)] == [(0, COUNT, 3), (0, COUNT, 3), (0, COUNT)]


def _above_water(lens, *shape):
    """Cameras two above the water that look straight down."""
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    center = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64).expand(*shape, 3)
    return RefractiveCamera(lens, down, center, FlatInterface(1.333))
