"""Where things appear to be, how they are lit up, and what refraction does to them."""

from dataclasses import replace

import pytest
import torch

from tests.camera.camera_scenes import (
    COUNT,
    at_every_place,
    for_every_interface,
    for_every_refraction,
    opencv_pinhole,
    scene,
)
from tests.tolerances import assert_matches, assert_same_pixels
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface


@for_every_interface
@at_every_place
def test_without_its_interface_a_camera_is_the_pinhole_of_opencv(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)
    points = points.lerp(camera.center_in_world + camera.cam_from_world_rotation[:, 2], 0.5)  # in the image

    pixels, valid = camera.as_pinhole().project(points)

    assert valid.all()
    assert_same_pixels(pixels, opencv_pinhole(camera, points))
    assert camera.as_pinhole().shape == (COUNT,)


@for_every_interface
@at_every_place
def test_the_pinhole_sees_apparent_points_where_the_camera_sees_the_points(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    apparent, valid = camera.apparent_points(points)

    assert valid.all()
    assert_same_pixels(camera.as_pinhole().project(apparent)[0], camera.project(points)[0], slack=10.0)


@for_every_interface
@at_every_place
def test_points_appear_to_be_lifted_along_the_normal_of_the_surface(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    apparent, _ = camera.apparent_points(points)

    normal = camera.plane_in_world().normal_like(points)
    lift = apparent - points
    rise = (lift * normal).sum(dim=-1, keepdim=True)
    assert_matches(lift, rise * normal, slack=100.0)
    assert place != "land" or lift.abs().max() < 1e-13


@for_every_interface
def test_straight_behind_the_surface_each_layer_appears_as_thick_as_its_index_makes_it(draw, lens, name):
    camera, points = scene(draw, lens, name, "nadir")

    depth, valid = camera.apparent_depth(points)

    assert valid.all()
    left = -camera.plane_in_world().signed_distance(points)
    first, *others = camera.interface.indices
    expected = torch.zeros(COUNT, dtype=torch.float64)
    for index, thickness in zip(others, (*camera.interface.thickness, torch.inf), strict=True):
        within = torch.minimum(left, torch.as_tensor(thickness, dtype=torch.float64))
        expected, left = expected + within * first / index, left - within
    assert_matches(depth, expected, slack=10.0)


def test_water_appears_a_quarter_shallower_from_straight_above(lens):
    camera = _looking_down(lens)

    depth, _ = camera.apparent_depth(torch.tensor([0.0, 0.0, -1.333], dtype=torch.float64))

    assert_matches(depth, torch.tensor(1.0, dtype=torch.float64))


def test_apparent_depth_is_negative_on_the_cameras_side_and_true_there(lens):
    camera = _looking_down(lens)

    depth, valid = camera.apparent_depth(torch.tensor([[0.3, -0.2, 0.5], [0.3, -0.2, 0.0]], dtype=torch.float64))

    assert valid.all()
    assert_matches(depth, torch.tensor([-0.5, 0.0], dtype=torch.float64))


def test_the_farther_off_the_shallower_water_appears(lens):
    camera = _looking_down(lens)
    points = torch.stack((torch.linspace(0.0, 50.0, 100, dtype=torch.float64), *(-z * torch.ones(100) for z in (0, 1))))

    depth, _ = camera.apparent_depth(points.mT.double())

    assert (depth.diff() < 0).all()
    assert (depth > 0).all()


@for_every_interface
def test_the_angle_of_incidence_and_the_ray_beyond_the_last_surface_fulfil_snells_law(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    if name == "into thick glass":
        points = points - 200.0 * camera.interface.plane.normal_like(points)  # beyond the glass

    angle, valid = camera.incidence_angle(points)

    assert valid.all()
    pixels, _ = camera.project(points)
    _, direction, met = camera.cast_rays(pixels)
    assert met.all()
    normal = camera.plane_in_world().normal_like(points).expand_as(direction)
    first, last = (torch.as_tensor(camera.interface.indices[i], dtype=torch.float64) for i in (0, -1))
    assert_matches(first * angle.sin(), last * torch.linalg.cross(direction, normal).norm(dim=-1), slack=10.0)
    viewing = camera.view_directions(pixels)
    assert_matches(angle.cos(), -(viewing * normal).sum(dim=-1), slack=10.0)


@for_every_interface
def test_the_angle_of_incidence_is_zero_straight_behind_the_surface(draw, lens, name):
    camera, points = scene(draw, lens, name, "nadir")

    angle, valid = camera.incidence_angle(points)

    assert valid.all()
    assert (angle < 1e-13).all()


def test_on_land_the_angle_of_incidence_is_that_of_the_straight_line(lens):
    camera = _looking_down(lens)  # two above the water

    angle, _ = camera.incidence_angle(torch.tensor([[1.0, 0.0, 1.0], [0.0, 3.0, 1.0]], dtype=torch.float64))

    assert_matches(torch.rad2deg(angle), torch.tensor([45.0, 71.56505117707799], dtype=torch.float64), slack=10.0)


@pytest.mark.parametrize("name", ["no refraction", "layers of one index"])
@at_every_place
def test_without_refraction_nothing_is_shifted(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    shift, valid = camera.refraction_shift(points)

    assert valid.all()
    assert shift.abs().max() < 1e-11


@for_every_interface
def test_on_land_nothing_is_shifted(draw, lens, name):
    camera, points = scene(draw, lens, name, "land")

    shift, valid = camera.refraction_shift(points)

    assert valid.all()
    assert shift.abs().max() < 1e-11


@pytest.mark.parametrize(("layers", "outwards"), [((1.0, 1.333), True), ((1.333, 1.0), False)])
def test_denser_media_move_the_image_away_from_the_foot_of_the_camera_and_rarer_ones_towards_it(
    draw, lens, layers, outwards
):
    straight = replace(lens, distortion=torch.zeros(5, dtype=torch.float64))
    camera = _looking_down(straight, FlatInterface(layers=layers))
    points = torch.cat((draw.uniform(-0.5, 0.5, 100, 2), draw.uniform(-2.0, -0.1, 100, 1)), dim=-1)

    shift, valid = camera.refraction_shift(points)

    assert valid.all()
    outward = (camera.as_pinhole().project(points)[0] - straight.principal_point) / straight.focal
    along = (shift / straight.focal * outward).sum(dim=-1)
    assert ((along > 0) == outwards).all()
    assert_matches(along.abs(), (shift / straight.focal).norm(dim=-1) * outward.norm(dim=-1), slack=100.0)


@for_every_refraction
def test_the_shift_is_the_difference_between_the_camera_and_its_pinhole(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    shift, valid = camera.refraction_shift(points)

    assert valid.all()
    assert_same_pixels(shift, camera.project(points)[0] - opencv_pinhole(camera, points))
    assert (shift.norm(dim=-1) > 0.1).all()


def test_a_shift_needs_both_images(lens):
    camera = _looking_down(lens)
    points = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 3.0]], dtype=torch.float64)

    assert camera.refraction_shift(points)[1].tolist() == [True, False]
    sunk = replace(camera, center_in_world=camera.center_in_world - 9.0, check=False)
    assert sunk.as_pinhole().project(points - 9.0)[1].tolist() == [True, False]
    assert not sunk.refraction_shift(points - 9.0)[1].any()


@for_every_interface
def test_the_plane_in_the_world_is_where_the_rays_meet_it(draw, lens, make_pixels, name):
    camera, pixels = scene(draw, lens, name, "ordinary")[0], make_pixels(COUNT, 50)
    interface = camera.interface
    first = FlatInterface(layers=interface.indices[:2] if interface.refracts().all() else (1.0, 1.0))
    bare = replace(
        camera, interface=replace(first, plane=interface.plane, moves_with_camera=interface.moves_with_camera)
    )

    origins, _, met = bare[:, None].cast_rays(pixels)

    assert met.sum() > 100
    distance = camera[:, None].plane_in_world().signed_distance(origins)
    assert distance[met].abs().max() < 1e-13
    assert (camera.plane_in_world().signed_distance(camera.center_in_world) > 0).all()


def test_a_plane_that_is_fixed_in_the_world_is_the_plane_itself(draw, lens):
    camera, _ = scene(draw, lens, "glass wall", "ordinary")

    assert camera.plane_in_world() is camera.interface.plane


def test_views_of_a_grid_of_cameras_and_points_are_grids(draw, lens):
    camera, points = scene(draw, lens, "each camera its own", "ordinary")
    grid = camera[:, None]

    for name in ("apparent_points", "apparent_depth", "incidence_angle", "refraction_shift"):
        value, valid = getattr(grid, name)(points)
        alone, _ = getattr(camera[2], name)(points)
        assert valid.shape == value.shape[:2] == (COUNT, COUNT), name
        assert_matches(value[2], alone, slack=100.0)


@pytest.mark.parametrize("name", ["apparent_points", "apparent_depth", "incidence_angle", "refraction_shift"])
def test_cameras_that_differ_only_in_their_lens_have_views_of_their_own(draw, lens, name):
    camera = _looking_down(replace(lens, focal=lens.focal + draw.uniform(0.0, 9.0, 3, 1, 1)))
    points = draw.uniform(-1.0, 0.0, 5, 3)

    value, valid = getattr(camera, name)(points)

    assert valid.shape == value.shape[:2] == (3, 5)


@pytest.mark.parametrize("name", ["water", "each camera its own", "tilted port"])
def test_views_are_differentiable_in_the_points(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    def views(points):
        names = ("apparent_points", "apparent_depth", "incidence_angle", "refraction_shift")
        return tuple(getattr(camera, view)(points)[0] for view in names)

    assert torch.autograd.gradcheck(views, points.requires_grad_(), rtol=1e-4, atol=1e-4)


def test_the_angle_of_incidence_has_finite_gradients_straight_behind_the_surface(draw, lens):
    camera, points = scene(draw, lens, "water", "nadir")
    points[:, :2] = camera.center_in_world[:, :2]
    points.requires_grad_()

    camera.incidence_angle(points)[0].sum().backward()

    assert points.grad.isfinite().all()


def _looking_down(lens, interface=None):
    """A camera two above the water that looks straight down."""
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    center = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    return RefractiveCamera(lens, down, center, FlatInterface(1.333, plane=Plane()) if interface is None else interface)
