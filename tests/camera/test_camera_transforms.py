"""The projection under mixed precision, function transforms and the compiler."""

from dataclasses import replace

import pytest
import torch

from tests.camera.camera_scenes import COUNT, for_every_interface, for_every_refraction, scene
from tests.tolerances import assert_matches, assert_same_pixels
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Plane, so3_exp
from torchrefrac.refraction import FlatInterface

HALVES = (torch.bfloat16, torch.float16)
SOME = ("water", "glass wall", "looking out through glass", "tilted port")
for_some_interfaces = pytest.mark.parametrize("name", SOME)


@for_every_interface
@pytest.mark.parametrize("half", HALVES)
def test_mixed_precision_changes_no_bit(draw, lens, name, half):
    camera, points = scene(draw, lens, name, "ordinary")
    camera, points = camera.to(dtype=torch.float32), points.float()
    expected = _everything(camera, points)

    with torch.autocast("cpu", half):
        results = _everything(camera, points)

    for result, without in zip(results, expected, strict=True):
        assert result.dtype == without.dtype
        assert torch.equal(result, without)


@for_some_interfaces
def test_mixed_precision_changes_no_bit_of_the_gradients(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    camera, points = camera.to(dtype=torch.float32), points.float()
    gradients = []

    for enabled in (False, True):
        at = points.clone().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            pixels, _ = camera.project(at)
        pixels.sum().backward()
        gradients.append(at.grad)

    assert torch.equal(*gradients)


def test_mixed_precision_changes_no_bit_of_the_rays_of_an_image(make_camera):
    camera = make_camera(2).to(dtype=torch.float32)
    expected = camera.rays(6, 8)

    with torch.autocast("cpu", torch.bfloat16):
        rays = camera.rays(6, 8)

    for ray, without in zip(rays, expected, strict=True):
        assert torch.equal(ray, without)


@for_every_interface
def test_vmap_over_points_is_the_batch(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    pixels, valid = torch.func.vmap(camera.project)(points.expand(3, COUNT, 3))

    expected, visible = camera.project(points)
    assert_same_pixels(pixels, expected.expand(3, COUNT, 2), slack=0.1)
    assert torch.equal(valid, visible.expand(3, COUNT))


@for_some_interfaces
def test_vmap_over_cameras_is_the_batch(draw, lens, name):
    cameras, points = scene(draw, lens, name, "ordinary")

    def project(rotation, center, point):
        return RefractiveCamera(lens, rotation, center, cameras.interface).project(point)[0]

    pixels = torch.func.vmap(project)(cameras.cam_from_world_rotation, cameras.center_in_world, points)

    assert_same_pixels(pixels, cameras.project(points)[0], slack=0.1)


def test_vmap_over_interfaces_is_the_batch_and_differentiable_both_ways(draw, make_camera, points_seen):
    camera = make_camera()

    def project(index, thickness, normal, offset, point):
        plane = Plane(normal, offset)
        interface = FlatInterface(layers=(1.0, 1.52, index), thickness=(thickness,), plane=plane)
        return replace(camera, interface=interface).project(point)[0]

    normals = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) + 0.1 * draw.normal(COUNT, 3)
    index, thickness = draw.uniform(1.1, 1.5, COUNT), draw.uniform(0.0, 0.3, COUNT)
    at = (index, thickness, normals, draw.uniform(-0.1, 0.1, COUNT), points_seen(camera, COUNT))
    assert_same_pixels(torch.func.vmap(project)(*at), project(*at), slack=0.1)
    forwards, backwards = (
        torch.func.vmap(transform(project, argnums=(0, 1, 2, 3)))(*at)
        for transform in (torch.func.jacfwd, torch.func.jacrev)
    )
    for forward, backward in zip(forwards, backwards, strict=True):
        assert_matches(forward, backward, slack=100.0)


@for_every_refraction
@pytest.mark.parametrize("transform", [torch.func.jacrev, torch.func.jacfwd])
def test_reverse_and_forward_mode_are_the_closed_form(draw, lens, name, transform):
    camera, points = scene(draw, lens, name, "ordinary")

    def project(turn, center, point, focal):
        return _moved(camera, turn, center, focal).project(point)[0].sum(dim=0)

    at = (torch.zeros(COUNT, 3, dtype=torch.float64), camera.center_in_world, points, lens.focal.repeat(COUNT, 1))
    jacobians = transform(project, argnums=(0, 1, 2, 3))(*at)

    blocks = camera.project_with_jacobians(points)[1]
    expected = (blocks.rotation, blocks.center, blocks.point, blocks.focal)
    for jacobian, block in zip(jacobians, expected, strict=True):
        size = block.abs().amax()
        assert_matches(jacobian.movedim(0, 1) / size, block / size, slack=100.0)


@for_some_interfaces
def test_vmap_of_the_jacobian_is_the_closed_form(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    def project(rotation, center, point):
        return RefractiveCamera(lens, rotation, center, camera.interface).project(point)[0]

    by_point = torch.func.vmap(torch.func.jacrev(project, argnums=2))(
        camera.cam_from_world_rotation, camera.center_in_world, points
    )

    expected = camera.project_with_jacobians(points)[1].point
    size = expected.abs().amax()
    assert_matches(by_point / size, expected / size, slack=100.0)


@for_some_interfaces
def test_vmap_of_the_closed_form_is_the_batch(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    pixels, blocks, _ = torch.func.vmap(camera.project_with_jacobians)(points.expand(3, COUNT, 3))

    expected_pixels, expected, _ = camera.project_with_jacobians(points)
    assert_same_pixels(pixels[1], expected_pixels, slack=0.1)
    for block, alone in zip(blocks, expected, strict=True):
        torch.testing.assert_close(block[1], alone, rtol=1e-12, atol=1e-9)


@for_some_interfaces
def test_rays_have_the_same_jacobian_forwards_and_backwards(draw, lens, make_pixels, name):
    camera, _ = scene(draw, lens, name, "ordinary")
    camera, pixels = camera[0], make_pixels()

    def cast(pixels):
        return camera.cast_rays(pixels)[:2]

    forwards, backwards = torch.func.jacfwd(cast)(pixels), torch.func.jacrev(cast)(pixels)

    for forward, backward in zip(forwards, backwards, strict=True):
        assert_matches(forward, backward, slack=100.0)


@for_some_interfaces
def test_second_derivatives_are_those_of_finite_differences(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    def project(points):
        return camera.project(points)[0] / 100.0

    assert torch.autograd.gradgradcheck(project, points.requires_grad_(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["water", *(pytest.param(name, marks=pytest.mark.slow) for name in SOME[1:])])
def test_the_compiled_projection_is_the_eager_one(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    def project(rotation, center, points):
        return RefractiveCamera(lens, rotation, center, camera.interface).project(points)

    at = (camera.cam_from_world_rotation, camera.center_in_world, points)
    pixels, valid = torch.compile(project, fullgraph=True, backend="aot_eager")(*at)

    expected, visible = camera.project(points)
    assert_same_pixels(pixels, expected, slack=0.1)
    assert torch.equal(valid, visible)


@pytest.mark.slow
def test_the_compiled_projection_has_the_gradients_of_the_eager_one(draw, lens):
    camera, points = scene(draw, lens, "glass wall", "ordinary")

    def total(points):
        return camera.project(points)[0].sum()

    points.requires_grad_()
    (gradient,) = torch.autograd.grad(torch.compile(total, fullgraph=True, backend="aot_eager")(points), points)

    (expected,) = torch.autograd.grad(total(points), points)
    assert_matches(gradient, expected, slack=1000.0)


@pytest.mark.slow
def test_the_compiled_rays_are_the_eager_ones(draw, lens, make_pixels):
    camera, pixels = scene(draw, lens, "glass wall", "ordinary")[0], make_pixels(COUNT)

    rays = torch.compile(camera.cast_rays, fullgraph=True, backend="aot_eager")(pixels)

    for ray, expected in zip(rays, camera.cast_rays(pixels), strict=True):
        torch.testing.assert_close(ray, expected, rtol=0.0, atol=1e-13)


@pytest.mark.slow
def test_the_compiled_closed_form_is_the_eager_one(draw, lens):
    camera, points = scene(draw, lens, "glass wall", "ordinary")

    _, blocks, _ = torch.compile(camera.project_with_jacobians, fullgraph=True, backend="aot_eager")(points)

    for block, expected in zip(blocks, camera.project_with_jacobians(points)[1], strict=True):
        torch.testing.assert_close(block, expected, rtol=1e-12, atol=1e-9)


def _moved(camera, turn, center, focal):
    return replace(
        camera,
        intrinsics=replace(camera.intrinsics, focal=focal),
        cam_from_world_rotation=so3_exp(turn) @ camera.cam_from_world_rotation,
        center_in_world=center,
    )


def _everything(camera, points):
    pixels, jacobians, valid = camera.project_with_jacobians(points)
    views = (camera.apparent_points, camera.apparent_depth, camera.incidence_angle, camera.refraction_shift)
    return [
        *(pixels, valid, *jacobians, *camera.project(points), *camera.cast_rays(pixels)),
        *(view(points)[0] for view in views),
    ]
