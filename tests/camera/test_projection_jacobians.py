"""Derivatives of the projection: closed form, autograd and finite differences."""

import math
from dataclasses import replace

import pytest
import torch

from tests.camera.camera_scenes import COUNT, INTERFACES, PLACES, at_every_place, for_every_interface, scene
from tests.tolerances import assert_matches
from torchrefrac.camera import ProjectionJacobians, RefractiveCamera, projection_along, projection_parts
from torchrefrac.camera.jacobians import BLOCKS
from torchrefrac.geometry import Plane, so3_exp
from torchrefrac.refraction import FlatInterface, lift_points

SLACK = 10.0  # a relative error of 1e-12


@pytest.fixture
def view(draw, make_camera, points_seen):
    """`view(place)`: cameras above water and the points that they look at, at an ordinary or a degenerate place."""

    def make(place):
        if place == "grazing":
            return _grazing(make_camera(COUNT))
        camera = make_camera(COUNT, index_ratio=1.0 if place == "index ratio 1" else 1.333)
        points = points_seen(camera, COUNT, land=place == "land")
        if place == "nadir":
            points[:, :2] = camera.center_in_world[:, :2]
        return camera, points

    return make


over_water = pytest.mark.parametrize("place", [*PLACES, "index ratio 1"])


@over_water
def test_every_block_is_that_of_autograd_through_the_projection(view, place):
    camera, points = view(place)

    _assert_jacobians_of_autograd(camera, points, slack=10.0)


@for_every_interface
@at_every_place
def test_every_block_is_that_of_autograd_through_any_interface(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    _assert_jacobians_of_autograd(camera, points, slack=SLACK)


@for_every_interface
@at_every_place
def test_a_small_step_in_all_parameters_changes_the_pixels_as_the_blocks_say(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)
    project, parameters = _by_parameters(camera, points)
    tried = [not (str(block) == "indices" and _lacks_refraction(name)) for block in ProjectionJacobians._fields]
    step = [1e-6 * use * draw.normal(*at.shape) for use, at in zip(tried, parameters, strict=True)]

    with torch.no_grad():
        ahead = project(*(at + by for at, by in zip(parameters, step, strict=True)))
        back = project(*(at - by for at, by in zip(parameters, step, strict=True)))

    blocks = camera.project_with_jacobians(points)[1]
    expected = sum(_change(block, by) for block, by in zip(blocks, step, strict=True))
    torch.testing.assert_close((ahead - back) / 2.0, expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("place", ["ordinary", "land", "nadir", "grazing"])
def test_autograd_through_the_projection_is_right_in_every_parameter(view, place):
    project, parameters = _by_parameters(*view(place))

    assert torch.autograd.gradcheck(project, parameters, rtol=1e-4, atol=1e-4)


def test_autograd_at_index_ratio_one_is_right_in_every_other_parameter(view):
    project, parameters = _by_parameters(*view("index ratio 1"))
    *before, indices, thickness, tilt, height = parameters

    def project_straight(*others):
        return project(*others[:-2], indices.detach(), thickness, *others[-2:])

    assert torch.autograd.gradcheck(project_straight, (*before, tilt, height), atol=1e-4)


@over_water
def test_the_pixels_and_the_mask_are_those_of_project(view, place):
    camera, points = view(place)

    pixels, _, valid = camera.project_with_jacobians(points)

    expected, expected_valid = camera.project(points)
    assert_matches(pixels, expected, slack=10.0)
    assert torch.equal(valid, expected_valid)


@for_every_interface
@at_every_place
def test_the_pixels_and_the_mask_are_those_of_project_through_any_interface(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    pixels, _, valid = camera.project_with_jacobians(points)

    expected, expected_valid = camera.project(points)
    assert_matches(pixels, expected, slack=10.0)
    assert torch.equal(valid, expected_valid)


@for_every_interface
def test_every_block_has_the_shape_of_the_batch_and_of_its_parameter(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    blocks = camera[:, None].project_with_jacobians(points[:4])[1]

    layers = len(INTERFACES[name].indices) - 1
    ends = ((2, 3), (2, 3), (2, 3), (2, 2), (2, 2), (2, 5), (2, layers), (2, layers - 1), (2, 2), (2,))
    assert [block.shape for block in blocks] == [(COUNT, 4, *end) for end in ends]
    assert torch.equal(blocks.index_ratio, blocks.indices[..., -1])


def test_at_a_water_surface_the_index_ratio_is_the_only_index(view):
    camera, points = view("ordinary")
    index_ratio = torch.full((COUNT,), 1.333, dtype=torch.float64, requires_grad=True)

    pixels, _ = replace(camera, interface=FlatInterface(index_ratio)).project(points)

    blocks = camera.project_with_jacobians(points)[1]
    for axis in range(2):
        (expected,) = torch.autograd.grad(pixels[:, axis].sum(), index_ratio, retain_graph=True)
        assert_matches(blocks.index_ratio[:, axis], expected, slack=SLACK)


def test_the_blocks_are_those_of_layers_of_which_only_the_ratios_of_indices_matter(draw, lens):
    camera, points = scene(draw, lens, "glass wall", "ordinary")
    twice = FlatInterface(layers=(2.0, 3.04, 2.0 * camera.interface.index_ratio), thickness=(0.1,))
    twice = replace(twice, plane=camera.interface.plane)

    blocks = replace(camera, interface=twice).project_with_jacobians(points)[1]

    for block, expected in zip(blocks, camera.project_with_jacobians(points)[1], strict=True):
        assert_matches(block, expected, slack=10.0)


def test_a_grid_of_cameras_and_points_gives_a_grid_of_jacobians(make_camera, points_seen):
    cameras = make_camera(3)
    points = points_seen(cameras[0], 5)

    _, grid, _ = cameras[:, None].project_with_jacobians(points)

    _, alone, _ = cameras[2].project_with_jacobians(points)
    for name, block, expected in zip(ProjectionJacobians._fields, grid, alone, strict=True):
        assert block.shape == (3, *expected.shape), name
        assert_matches(block[2], expected, slack=10.0)


def test_points_on_land_do_not_feel_the_interface(draw, lens):
    camera, points = scene(draw, lens, "glass wall", "land")

    blocks = camera.project_with_jacobians(points)[1]

    for block in (blocks.indices, blocks.thickness, blocks.plane_tilt, blocks.plane_height):
        assert torch.equal(block, torch.zeros_like(block))
    assert_matches(blocks.center, -blocks.point)


def test_a_layer_that_the_light_does_not_reach_has_no_part_in_the_pixel(draw, lens):
    camera, points = scene(draw, lens, "into thick glass", "ordinary")

    jacobians = camera.project_with_jacobians(points)[1]

    assert (jacobians.indices[..., 0] != 0).all()
    assert torch.equal(jacobians.indices[..., 1], torch.zeros_like(jacobians.indices[..., 1]))
    assert torch.equal(jacobians.thickness, torch.zeros_like(jacobians.thickness))


@for_every_interface
def test_camera_plane_and_point_that_move_together_leave_the_image_as_it_is(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    blocks = camera.project_with_jacobians(points)[1]

    normal = camera.interface.plane.normal_like(points)
    moved = torch.zeros_like(blocks.plane_height)
    if not camera.interface.moves_with_camera:
        moved = blocks.plane_height
    together = blocks.center + blocks.point + moved[..., None] * normal.expand(COUNT, 3)[:, None]
    size = blocks.point.abs().amax()
    assert_matches(together / size, torch.zeros_like(together), slack=10.0)


@pytest.mark.parametrize("name", ["water", "glass wall", "looking out", "tilted port", "each camera its own"])
def test_entries_that_are_not_valid_are_finite(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    normal = camera.plane_in_world().normal_like(points)
    points[:3] = 2.0 * camera.center_in_world[:3] - points[:3]  # behind the camera
    points[2] = camera.center_in_world[2]
    if camera.interface.moves_with_camera:
        points[3:] = 2.0 * camera.center_in_world[3:] - points[3:]
    center = camera.center_in_world.clone()
    center[3:] -= 10.0 * normal.expand(COUNT, 3)[3:]  # on the wrong side, but for the port
    sunk = replace(camera, center_in_world=center, check=False)

    pixels, jacobians, valid = sunk.project_with_jacobians(points)

    assert not valid[:3].any()
    assert camera.interface.moves_with_camera or not valid.any()
    assert pixels.isfinite().all()
    assert all(block.isfinite().all() for block in jacobians)


def test_gradients_of_valid_points_survive_beside_points_that_are_not(view):
    camera, points = view("ordinary")
    points[0] = 2.0 * camera.center_in_world[0] - points[0]
    points[1] = camera.center_in_world[1]
    points.requires_grad_()

    camera.project(points)[0].sum().backward()

    assert points.grad.isfinite().all()
    assert (points.grad[2:] != 0).all()


@for_every_interface
@at_every_place
def test_the_parts_are_the_blocks_before_they_are_stacked(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    pixels, valid, blocks = _parts_of(camera, points)

    expected, jacobians, expected_valid = camera.project_with_jacobians(points)
    assert_matches(pixels, expected)
    assert torch.equal(valid, expected_valid)
    for block in {*BLOCKS, "principal_point"} & set(blocks):
        part = blocks[block][..., 0] if block == "plane_height" else blocks[block]
        assert_matches(part, getattr(jacobians, block))


@for_every_interface
def test_parts_that_are_not_wanted_change_none_that_are(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    _, _, everything = _parts_of(camera, points)

    for block in set(BLOCKS) & set(everything):
        _, _, alone = _parts_of(camera, points, wanted=(block,))

        assert torch.equal(alone[block], everything[block]), block


@pytest.mark.parametrize("name", ["water", "tilted water"])
@pytest.mark.parametrize("place", ["ordinary", "nadir", "land"])
def test_with_the_refrax_ratio_frozen_the_parts_are_those_of_autograd_with_a_constant_ratio(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)
    project, parameters = _by_parameters(camera, points, with_frozen_ratio=True)
    pixels = project(*parameters)

    at, _, blocks = _parts_of(camera, points, frozen_ratio=True)

    assert_matches(at, pixels.detach(), slack=10.0)
    for axis in range(2):
        gradients = torch.autograd.grad(pixels[:, axis].sum(), parameters, retain_graph=True, materialize_grads=True)
        for block, gradient in zip(ProjectionJacobians._fields, gradients, strict=True):
            if not gradient.numel():
                continue
            size = gradient.abs().amax().clamp(min=1.0)
            actual = blocks[block][:, axis].reshape(gradient.shape)
            assert_matches(actual / size, gradient / size, slack=SLACK)


def test_with_the_refrax_ratio_frozen_depth_and_index_have_no_derivative_under_water_and_land_is_exact(draw, lens):
    below, above = scene(draw, lens, "water", "ordinary"), scene(draw, lens, "water", "land")

    frozen, exact = (_parts_of(*below, frozen_ratio=value)[2] for value in (True, False))

    assert torch.equal(frozen["indices"], torch.zeros_like(frozen["indices"]))
    assert frozen["point"][..., 2].abs().amax() < 1e-12 * exact["point"][..., 2].abs().amax()
    on_land, straight = (_parts_of(*above, frozen_ratio=value)[2] for value in (True, False))
    assert all(torch.equal(on_land[block], straight[block]) for block in on_land)


@over_water
def test_a_moving_point_moves_in_the_image_as_its_jacobian_says(draw, view, place):
    _assert_moves_by_the_jacobian(draw, *view(place))


@for_every_interface
@at_every_place
def test_it_does_so_behind_every_interface(draw, lens, name, place):
    _assert_moves_by_the_jacobian(draw, *scene(draw, lens, name, place))


def _assert_moves_by_the_jacobian(draw, camera, points):
    directions = draw.normal(*points.shape)
    where = (camera.intrinsics, camera.cam_from_world_rotation, camera.center_in_world, points)

    pixel, along, valid = projection_along(*where, directions, camera.interface)

    pixels, jacobians, expected_valid = camera.project_with_jacobians(points)
    moved = (jacobians.point @ directions[..., None])[..., 0]
    assert_matches(torch.stack(pixel, dim=-1), pixels)
    assert_matches(torch.stack(along, dim=-1), moved, slack=SLACK)
    assert torch.equal(valid, expected_valid)


def _parts_of(camera, points, frozen_ratio=False, wanted=BLOCKS):
    """`projection_parts` with its numbers stacked as `project_with_jacobians` gives them."""
    pixel, valid, by = projection_parts(
        camera.intrinsics,
        camera.cam_from_world_rotation,
        camera.center_in_world,
        points,
        camera.interface,
        wanted,
        frozen_ratio,
    )
    blocks = {
        name: torch.stack([torch.stack(tuple(axis), dim=-1) for axis in axes], dim=-2)
        for name, axes in by.items()
        if len(axes[0])  # of a block that was not wanted there may be nothing
    }
    return torch.stack(pixel, dim=-1), valid, blocks


def _assert_jacobians_of_autograd(camera, points, slack):
    project, parameters = _by_parameters(camera, points)
    pixels = project(*parameters)
    assert camera.project(points)[1].all()

    jacobians = camera.project_with_jacobians(points)[1]

    for axis in range(2):
        gradients = torch.autograd.grad(pixels[:, axis].sum(), parameters, retain_graph=True)
        for name, block, gradient in zip(ProjectionJacobians._fields, jacobians, gradients, strict=True):
            size = gradient.abs().amax().clamp(min=1.0) if gradient.numel() else 1.0
            assert block.shape == (COUNT, 2, *gradient.shape[1:]), name
            assert_matches(block[:, axis] / size, gradient / size, slack=slack)


def _by_parameters(camera, points, with_frozen_ratio=False):
    """The projection as a function of what `ProjectionJacobians` differentiates in, and where it is evaluated.

    with_frozen_ratio: the refrax is q = c + lambda (p - c) along the water (paper, Eq. 5), lambda a constant (Eq. 21).
    """
    lens, interface = camera.intrinsics, camera.interface
    first, *others = (torch.as_tensor(index, dtype=torch.float64).expand(COUNT) for index in interface.indices)
    plane, nothing = Plane(interface.plane.normal_like(points), interface.plane.offset), torch.zeros_like(first)

    def project(*parameters):
        turn, center, point, focal, principal_point, distortion, indices, thickness, tilt, height = parameters
        if interface.layers is None:
            media = replace(interface, index_ratio=indices[..., 0], plane=plane.moved(tilt, height))
        else:
            thrice = 3.0 * first  # only ratios matter
            layers = (thrice, *(thrice * index for index in indices.unbind(dim=-1)))
            inner = tuple(thickness.unbind(dim=-1))
            media = replace(
                interface, index_ratio=None, layers=layers, thickness=inner, plane=plane.moved(tilt, height)
            )
        eye = replace(lens, focal=focal, principal_point=principal_point, distortion=distortion)
        rotation = so3_exp(turn) @ camera.cam_from_world_rotation
        if with_frozen_ratio:
            refrax = _refrax_of_frozen_ratio(center, point, media)
            return RefractiveCamera(eye, rotation, center, FlatInterface(1.0)).project(refrax)[0]
        unused = 0.0 * thickness.sum()  # where there are no layers
        return RefractiveCamera(eye, rotation, center, media).project(point)[0] + unused

    values = (
        torch.zeros(3, dtype=torch.float64),
        camera.center_in_world,
        points,
        lens.focal,
        lens.principal_point,
        lens.distortion,
        torch.stack([index / first for index in others], dim=-1),
        torch.stack([nothing, *(nothing + d for d in interface.thickness)], dim=-1)[:, 1:],
        torch.zeros(2, dtype=torch.float64),
        torch.zeros((), dtype=torch.float64),
    )
    sizes = ((3,), (3,), (3,), (2,), (2,), (5,), (len(others),), (len(others) - 1,), (2,), ())
    return project, [
        value.expand(COUNT, *size).clone(memory_format=torch.contiguous_format).requires_grad_()
        for value, size in zip(values, sizes, strict=True)
    ]


def _refrax_of_frozen_ratio(center, point, water):
    """Where the ray (*B) meets the water; on land the point itself."""
    normal, height = water.plane.normal_like(point), water.plane.signed_distance(center)
    offset = point - center
    along = (offset * normal).sum(dim=-1, keepdim=True)
    apparent, _ = lift_points(center, point, water)
    ratio = (height / -(apparent * normal).sum(dim=-1)).detach()[:, None]
    refrax = center + ratio * (offset - along * normal) - height[:, None] * normal
    return torch.where(water.plane.signed_distance(point)[:, None] > 0.0, point, refrax)


def _lacks_refraction(name):
    """There a step in the index may make it less than 1."""
    return not INTERFACES[name].refracts().all()


def _change(block, by):
    """Change (*B, 2) of the pixels by a step in the parameter of that block."""
    return (block.reshape(COUNT, 2, -1) @ by.reshape(COUNT, -1, 1))[..., 0]


def _grazing(camera):
    """Cameras that look 89 degrees away from the nadir, nearly along the water."""
    tilt = torch.tensor(math.radians(89.0), dtype=torch.float64)
    forward = torch.stack((torch.zeros_like(tilt), tilt.sin(), -tilt.cos()))
    right = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward)).expand(COUNT, 3, 3)
    level = replace(camera, cam_from_world_rotation=rotation)
    origins, directions, _ = level.cast_rays(level.intrinsics.principal_point + torch.zeros(COUNT, 2, dtype=tilt.dtype))
    return level, origins + torch.linspace(0.2, 2.0, COUNT, dtype=tilt.dtype)[:, None] * directions
