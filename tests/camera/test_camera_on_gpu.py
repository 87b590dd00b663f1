"""Cameras on a GPU."""

import pytest
import torch

from tests.camera.camera_scenes import COUNT, for_every_interface, scene
from tests.tolerances import TOLERANCE, assert_same_pixels

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
DTYPES = (torch.float64, torch.float32)
in_every_dtype = pytest.mark.parametrize("dtype", DTYPES)


@for_every_interface
@in_every_dtype
def test_projection_is_that_of_the_cpu(draw, lens, name, dtype):
    camera, points = _as(dtype, *scene(draw, lens, name, "ordinary"))

    pixels, valid = camera.to(device="cuda").project(points.cuda())

    expected, visible = camera.project(points)
    assert pixels.is_cuda
    assert_same_pixels(pixels.cpu(), expected)
    assert torch.equal(valid.cpu(), visible)


@for_every_interface
@in_every_dtype
def test_jacobians_are_those_of_the_cpu(draw, lens, name, dtype):
    camera, points = _as(dtype, *scene(draw, lens, name, "ordinary"))

    _, blocks, _ = camera.to(device="cuda").project_with_jacobians(points.cuda())

    for block, expected in zip(blocks, camera.project_with_jacobians(points)[1], strict=True):
        size = expected.abs().amax().clamp(min=1.0)
        tolerance = 100.0 * TOLERANCE[dtype].rounding
        torch.testing.assert_close(block.cpu() / size, expected / size, rtol=0.0, atol=tolerance)


@for_every_interface
@in_every_dtype
def test_rays_are_those_of_the_cpu(draw, lens, make_pixels, name, dtype):
    camera, pixels = _as(dtype, scene(draw, lens, name, "ordinary")[0], make_pixels(COUNT))

    origins, directions, valid = camera.to(device="cuda").cast_rays(pixels.cuda())

    expected_origins, expected_directions, met = camera.cast_rays(pixels)
    tolerance = 100.0 * TOLERANCE[dtype].rounding
    torch.testing.assert_close(origins.cpu(), expected_origins, rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(directions.cpu(), expected_directions, rtol=tolerance, atol=tolerance)
    assert torch.equal(valid.cpu(), met)


@for_every_interface
def test_gradients_are_those_of_the_cpu(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    on_gpu, on_cpu = points.cuda().requires_grad_(), points.clone().requires_grad_()

    camera.to(device="cuda").project(on_gpu)[0].sum().backward()

    camera.project(on_cpu)[0].sum().backward()
    torch.testing.assert_close(on_gpu.grad.cpu(), on_cpu.grad, rtol=1e-10, atol=1e-10)


def test_mixed_precision_changes_no_bit(draw, lens):
    camera, points = _as(torch.float32, *scene(draw, lens, "glass wall", "ordinary"))
    camera, points = camera.to(device="cuda"), points.cuda()
    expected = camera.project(points)[0], *camera.project_with_jacobians(points)[1]

    with torch.autocast("cuda", torch.float16):
        results = camera.project(points)[0], *camera.project_with_jacobians(points)[1]

    for result, without in zip(results, expected, strict=True):
        assert torch.equal(result, without)


def test_without_its_check_a_camera_does_not_wait_for_the_gpu(draw, lens):
    camera, points = scene(draw, lens, "glass wall", "ordinary")
    camera, points = camera.to(device="cuda"), points.cuda()
    camera.project(points)

    torch.cuda.set_sync_debug_mode("error")
    try:
        camera[1:].project(points[1:])
        camera.project_with_jacobians(points)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def _as(dtype, camera, values):
    return camera.to(dtype=dtype), values.to(dtype)
