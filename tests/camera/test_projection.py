"""Projection and back projection through the water surface."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.optimize import brentq

from tests.camera.camera_scenes import opencv_pinhole
from tests.tolerances import assert_matches, assert_same_pixels
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Plane, heading_rotation, so3_exp
from torchrefrac.refraction import FlatInterface

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
ONE = torch.ones(100, dtype=torch.float64)


def test_projection_is_that_of_the_quickest_path_of_light_and_an_opencv_lens(make_camera, points_seen):
    camera = make_camera(100)
    points = points_seen(camera, 100)

    pixels, valid = camera.project(points)

    assert valid.all()
    refraxes = _quickest_refraxes(camera.center_in_world, points, 1.333)
    assert_same_pixels(pixels, opencv_pinhole(camera, refraxes), slack=10.0)


def test_a_land_point_projects_as_opencv_says(make_camera, points_seen):
    camera = make_camera(100)
    points = points_seen(camera, 100, land=True)

    pixels, valid = camera.project(points)

    assert valid.all()
    assert_same_pixels(pixels, opencv_pinhole(camera, points))


def test_at_index_ratio_one_projection_is_the_pinhole_of_a_matrix_product_and_of_opencv(draw, make_camera):
    camera = make_camera(100, index_ratio=1.0)
    points = camera.center_in_world + draw.uniform(-1.0, 1.0, 100, 3) - 3.0 * UP

    pixels, valid = camera.project(points)

    assert valid.all()
    x, y, z = (camera.cam_from_world_rotation @ (points - camera.center_in_world)[..., None])[..., 0].unbind(dim=-1)
    by_product = camera.intrinsics.pixels_from_plane(torch.stack((x, y), dim=-1) / z[..., None])
    torch.testing.assert_close(pixels, by_product, rtol=0.0, atol=1e-12)
    assert_same_pixels(pixels, opencv_pinhole(camera, points))


@pytest.mark.parametrize(
    "interface",
    [
        FlatInterface(ONE[0]),
        FlatInterface(ONE),
        FlatInterface(1.0, plane=Plane((0.3, 0.1, 1.0), 0.4)),
        FlatInterface(layers=(1.333, 1.333)),
        FlatInterface(layers=(1.5, 1.5, 1.5), thickness=(0.2,)),
        FlatInterface(layers=1.333 * ONE[:3], thickness=(0.2,)),
        FlatInterface(layers=(ONE, 1.0, ONE), thickness=(0.2 * ONE,)),
        FlatInterface(layers=(ONE, ONE), plane=Plane((0.0, 0.0, -1.0), -0.1), moves_with_camera=True),
    ],
    ids=["tensor", "tensors", "tilted", "two", "three", "one tensor", "batched layers", "port"],
)
def test_an_interface_of_one_index_in_any_form_is_none(draw, make_camera, interface):
    camera = make_camera(100, index_ratio=1.0)
    points = camera.center_in_world + draw.uniform(-1.0, 1.0, 100, 3) - 3.0 * UP

    pixels, valid = replace(camera, interface=interface).project(points)

    assert valid.all()
    torch.testing.assert_close(pixels, camera.project(points)[0], rtol=0.0, atol=1e-12)


def test_the_number_one_means_no_interface_to_the_last_bit(draw, make_camera):
    camera = make_camera(100)
    points = camera.center_in_world + draw.uniform(-1.0, 1.0, 100, 3) - 3.0 * UP

    pixels, _ = camera.as_pinhole().project(points)

    for one in (1.0, 1):
        assert torch.equal(pixels, replace(camera, interface=FlatInterface(one)).project(points)[0])
    wall = replace(camera, interface=FlatInterface.glass_wall(Plane((0.1, 0.0, 1.0), -9.0), 0.1))
    assert torch.equal(pixels, wall.as_pinhole().project(points)[0])


@pytest.mark.parametrize("index_ratio", [1.0, 1.333, 2.0])
def test_a_point_anywhere_on_the_ray_of_a_pixel_projects_to_that_pixel(draw, make_camera, make_pixels, index_ratio):
    camera, pixels = make_camera(500, index_ratio=index_ratio), make_pixels(500)
    origins, directions, met = camera.cast_rays(pixels)
    points = origins + draw.power_of_ten(-3.0, 1.0, 500, 1) * directions

    back, valid = camera.project(points)

    assert (met & valid).all()
    assert_same_pixels(back, pixels)


def test_rays_leave_from_the_surface_along_unit_vectors_downwards(make_camera, make_pixels):
    origins, directions, _ = make_camera(100).cast_rays(make_pixels(100))

    assert torch.equal(origins[:, 2], torch.zeros(100, dtype=torch.float64))
    assert_matches(directions.norm(dim=-1), torch.ones(100, dtype=torch.float64))
    assert (directions[:, 2] < 0).all()


def test_at_index_ratio_one_rays_go_straight_through_the_surface(make_camera, make_pixels):
    camera, pixels = make_camera(100, index_ratio=1.0), make_pixels(100)

    origins, directions, valid = camera.cast_rays(pixels)

    assert valid.all()
    viewing = camera.view_directions(pixels)
    assert_matches(directions, viewing)
    from_center = torch.nn.functional.normalize(origins - camera.center_in_world, dim=-1)
    assert_matches(from_center, viewing)


def test_the_principal_point_looks_along_the_optical_axis(make_camera):
    camera = make_camera(20)

    viewing = camera.view_directions(camera.intrinsics.principal_point)

    assert_matches(viewing, camera.cam_from_world_rotation[:, 2])


def test_one_camera_takes_points_of_any_leading_shape(make_camera, points_seen):
    camera = make_camera()
    points = points_seen(camera, 3, 4)

    pixels, valid = camera.project(points)

    assert pixels.shape == (3, 4, 2)
    assert valid.shape == (3, 4)
    assert_same_pixels(pixels[2, 1], camera.project(points[2, 1])[0])


def test_an_index_with_none_makes_a_grid_of_cameras_and_points(make_camera, points_seen, make_pixels):
    cameras = make_camera(3)
    points, pixels = points_seen(cameras[0], 5), make_pixels(5)

    seen, valid = cameras[:, None].project(points)
    rays = cameras[:, None].cast_rays(pixels)[:2]

    assert seen.shape == (3, 5, 2)
    assert valid.shape == (3, 5)
    assert_same_pixels(seen[2], cameras[2].project(points)[0])
    for grid, alone in zip(rays, cameras[2].cast_rays(pixels)[:2], strict=True):
        assert_matches(grid[2], alone)


def test_every_camera_may_have_its_own_index_ratio(draw, make_camera, points_seen):
    index = draw.uniform(1.0, 1.5, 4)
    cameras = make_camera(4, index_ratio=index)
    points = points_seen(cameras, 4)

    pixels, _ = cameras.project(points)

    for i in range(4):
        camera = replace(cameras[i], interface=FlatInterface(index[i]))
        assert_same_pixels(pixels[i], camera.project(points[i])[0])


def test_one_camera_may_be_tried_with_many_index_ratios(make_camera, points_seen):
    index = torch.tensor([[1.1], [1.333], [1.5]], dtype=torch.float64)
    camera = make_camera(index_ratio=index)
    points = points_seen(make_camera(), 4)

    pixels, _ = camera.project(points)

    assert pixels.shape == (3, 4, 2)
    alone = replace(camera, interface=FlatInterface(1.5))
    assert_same_pixels(pixels[2], alone.project(points)[0])


def test_single_precision_projects_to_well_below_a_pixel(make_camera, points_seen):
    camera = make_camera(500)
    points = points_seen(camera, 500)
    single = RefractiveCamera(
        camera.intrinsics.to(dtype=torch.float32),
        camera.cam_from_world_rotation.float(),
        camera.center_in_world.float(),
        camera.interface,
    )

    pixels, _ = single.project(points.float())

    assert pixels.dtype == torch.float32
    assert_same_pixels(pixels, camera.project(points)[0].float())


def test_points_behind_the_camera_are_masked_and_stay_finite(make_camera, points_seen):
    camera = make_camera(50)
    points = points_seen(camera, 50, land=True)
    mirrored = 2.0 * camera.center_in_world - points  # above the camera

    pixels, valid = camera.project(mirrored)

    assert not valid.any()
    assert pixels.isfinite().all()


@pytest.mark.parametrize(("index_ratio", "expected"), [(1.333, False), (1.0, True)])
def test_a_camera_under_water_is_masked_but_for_index_ratio_one(make_camera, points_seen, index_ratio, expected):
    camera = make_camera(50, index_ratio=index_ratio)
    points = points_seen(camera, 50, land=True)
    sunk = replace(camera, center_in_world=camera.center_in_world - 10.0 * UP, check=False)

    pixels, valid = sunk.project(points - 10.0 * UP)

    assert (valid == expected).all()
    assert_same_pixels(pixels, camera.project(points)[0])


def test_a_pixel_that_looks_at_the_sky_has_no_ray_in_the_water(lens):
    level = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)  # looks along y
    center = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    camera = RefractiveCamera(lens, level, center, FlatInterface(1.333))
    pixels = torch.tensor([[500.0, 100.0], [500.0, 700.0]], dtype=torch.float64)

    origins, directions, valid = camera.cast_rays(pixels)

    assert valid.tolist() == [False, True]
    assert torch.equal(origins[0], center)
    assert_matches(directions[0], camera.view_directions(pixels)[0])


def test_a_turn_about_the_vertical_and_a_shift_along_the_water_leave_the_image_as_it_is(draw, make_camera, points_seen):
    camera = make_camera(100)
    points = points_seen(camera, 100)
    turn = heading_rotation(draw.uniform(-math.pi, math.pi))
    shift = draw.normal(3) * (1.0 - UP)
    moved = replace(
        camera,
        cam_from_world_rotation=camera.cam_from_world_rotation @ turn.mT,
        center_in_world=camera.center_in_world @ turn.mT + shift,
    )

    assert_same_pixels(moved.project(points @ turn.mT + shift)[0], camera.project(points)[0])


def test_a_change_of_scale_about_the_water_leaves_the_image_as_it_is(make_camera, points_seen):
    camera = make_camera(100)
    points = points_seen(camera, 100)
    larger = replace(camera, center_in_world=37.0 * camera.center_in_world)

    assert_same_pixels(larger.project(37.0 * points)[0], camera.project(points)[0])


def test_a_vertical_shift_changes_the_image_only_where_light_is_refracted(make_camera, points_seen):
    for index_ratio, changes in ((1.333, True), (1.0, False)):
        camera = make_camera(100, index_ratio=index_ratio)
        points = points_seen(camera, 100)
        raised = replace(camera, center_in_world=camera.center_in_world + 0.05 * UP)
        change = (raised.project(points + 0.05 * UP)[0] - camera.project(points)[0]).norm(dim=-1)
        assert (change.median() > 0.1) == changes


def test_rays_are_differentiable_in_pixel_pose_and_lens(make_camera, make_pixels):
    camera = make_camera(2)

    def cast(pixels, turn, center, *lens_parameters):
        focal, principal_point, distortion = lens_parameters
        lens = replace(camera.intrinsics, focal=focal, principal_point=principal_point, distortion=distortion)
        rotation = so3_exp(turn) @ camera.cam_from_world_rotation
        return RefractiveCamera(lens, rotation, center, camera.interface).cast_rays(pixels)[:2]

    lens, turn = camera.intrinsics, torch.zeros(2, 3, dtype=torch.float64)
    at = (make_pixels(2), turn, camera.center_in_world, lens.focal, lens.principal_point, lens.distortion)
    assert torch.autograd.gradcheck(cast, [value.clone().requires_grad_() for value in at])


@pytest.mark.parametrize(
    ("rotation", "center", "message"),
    [
        ((3,), (3,), r"cam_from_world_rotation has shape \(3,\), but must end in \(3, 3\)"),
        ((3, 3), (2,), r"center_in_world has shape \(2,\), but must end in \(3,\)"),
    ],
)
def test_poses_of_a_wrong_shape_are_refused(lens, rotation, center, message):
    with pytest.raises(ValueError, match=message):
        RefractiveCamera(lens, torch.zeros(rotation), torch.zeros(center), FlatInterface())


@pytest.mark.parametrize("name", ["cam_from_world_rotation", "center_in_world"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("index_ratio", [1.0, 1.333])
def test_a_pose_that_is_not_finite_is_refused_by_name(make_camera, name, bad, index_ratio):
    camera = make_camera(3, index_ratio=index_ratio)
    pose = getattr(camera, name).clone()
    pose[1, 0] = bad

    with pytest.raises(ValueError, match=f"^{name} is {bad} somewhere, but must be finite"):
        replace(camera, **{name: pose})


@pytest.mark.parametrize("height", [-0.5, 0.0])
def test_a_camera_that_does_not_stand_above_the_water_is_refused(make_camera, height):
    camera = make_camera(3)
    center = camera.center_in_world.clone()
    center[1, 2] = height

    with pytest.raises(ValueError, match=r"^center_in_world is -?0(\.5)? behind the interface somewhere, but must be"):
        replace(camera, center_in_world=center)


def test_a_camera_below_a_tilted_plane_is_refused_though_it_stands_above_the_origin(make_camera):
    camera = make_camera()
    center = torch.tensor([-3.0, 0.0, 2.0], dtype=torch.float64)  # (1, 0, 1) has it below
    tilted = FlatInterface(1.333, plane=Plane((1.0, 0.0, 1.0), 0.0))

    with pytest.raises(ValueError, match=r"^center_in_world is 0\.70710\d behind the interface"):
        replace(camera, center_in_world=center, interface=tilted)
    replace(camera, center_in_world=center, interface=replace(tilted, plane=Plane((-1.0, 0.0, -1.0), 0.0)))
    replace(camera, center_in_world=center, interface=FlatInterface(1.0, plane=tilted.plane))


def test_a_port_behind_the_camera_is_refused(make_camera):
    with pytest.raises(ValueError, match=r"^interface.plane lies 0\.1 behind the camera"):
        replace(make_camera(3), interface=FlatInterface.flat_port(-0.1, 0.01))


def test_only_the_cameras_at_an_interface_that_refracts_must_stand_on_its_side(make_camera):
    camera = make_camera(2)
    center = camera.center_in_world.clone()
    center[1, 2] = -1.0
    one_bends = FlatInterface(torch.tensor([1.333, 1.0], dtype=torch.float64))

    replace(camera, center_in_world=center, interface=one_bends)
    with pytest.raises(ValueError, match="behind the interface"):
        replace(camera, center_in_world=center.flip(0), interface=one_bends)


def test_the_refusal_tells_how_deep_the_camera_stands_that_must_not(make_camera):
    camera = make_camera(2)
    center = camera.center_in_world.clone()
    center[:, 2] = torch.tensor([-1.5, -9.0])
    one_bends = FlatInterface(torch.tensor([1.333, 1.0], dtype=torch.float64))

    with pytest.raises(ValueError, match=r"^center_in_world is 1\.5 behind the interface"):
        replace(camera, center_in_world=center, interface=one_bends)


def _quickest_refraxes(centers, points, index):
    """Points on the surface through which light travels quickest (Fermat), in plain Python, one by one."""
    refraxes = []
    for center, point in zip(centers.tolist(), points.tolist(), strict=True):
        height, depth = center[2], -point[2]
        distance = math.dist(center[:2], point[:2])

        def slowing(x, height=height, depth=depth, distance=distance):
            return x / math.hypot(x, height) - index * (distance - x) / math.hypot(distance - x, depth)

        ratio = brentq(slowing, 0.0, distance, xtol=1e-300, rtol=1e-15) / distance
        refraxes.append([c + ratio * (p - c) for c, p in zip(center[:2], point[:2], strict=True)] + [0.0])
    return torch.tensor(refraxes, dtype=torch.float64)
