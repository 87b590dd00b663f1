"""Cameras on other devices than the CPU."""

import pytest
import torch

from tests.camera.camera_scenes import COUNT, for_every_interface, scene
from tests.made_device import on_every_device, without_waiting
from tests.tolerances import TOLERANCE, assert_same_pixels

DTYPES = (torch.float64, torch.float32)
in_every_dtype = pytest.mark.parametrize("dtype", DTYPES)


@on_every_device
@for_every_interface
@in_every_dtype
def test_projection_is_that_of_the_cpu(draw, lens, name, dtype, device):
    camera, points = _as(dtype, *scene(draw, lens, name, "ordinary"))

    pixels, valid = camera.to(device=device).project(points.to(device))

    expected, visible = camera.project(points)
    assert pixels.device.type == device
    assert_same_pixels(pixels.cpu(), expected)
    assert torch.equal(valid.cpu(), visible)


@on_every_device
@for_every_interface
@in_every_dtype
def test_jacobians_are_those_of_the_cpu(draw, lens, name, dtype, device):
    camera, points = _as(dtype, *scene(draw, lens, name, "ordinary"))

    _, blocks, _ = camera.to(device=device).project_with_jacobians(points.to(device))

    for block, expected in zip(blocks, camera.project_with_jacobians(points)[1], strict=True):
        size = max(1.0, float(expected.abs().amax())) if expected.numel() else 1.0
        tolerance = 100.0 * TOLERANCE[dtype].rounding
        torch.testing.assert_close(block.cpu() / size, expected / size, rtol=0.0, atol=tolerance)


@on_every_device
@for_every_interface
@in_every_dtype
def test_rays_are_those_of_the_cpu(draw, lens, make_pixels, name, dtype, device):
    camera, pixels = _as(dtype, scene(draw, lens, name, "ordinary")[0], make_pixels(COUNT))

    origins, directions, valid = camera.to(device=device).cast_rays(pixels.to(device))

    expected_origins, expected_directions, met = camera.cast_rays(pixels)
    tolerance = 100.0 * TOLERANCE[dtype].rounding
    torch.testing.assert_close(origins.cpu(), expected_origins, rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(directions.cpu(), expected_directions, rtol=tolerance, atol=tolerance)
    assert torch.equal(valid.cpu(), met)


@on_every_device
@for_every_interface
def test_gradients_are_those_of_the_cpu(draw, lens, name, device):
    camera, points = scene(draw, lens, name, "ordinary")
    there, here = points.to(device).requires_grad_(), points.clone().requires_grad_()

    camera.to(device=device).project(there)[0].sum().backward()

    camera.project(here)[0].sum().backward()
    torch.testing.assert_close(there.grad.cpu(), here.grad, rtol=1e-10, atol=1e-10)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_mixed_precision_changes_no_bit(draw, lens):
    camera, points = _as(torch.float32, *scene(draw, lens, "glass wall", "ordinary"))
    camera, points = camera.to(device="cuda"), points.cuda()
    expected = camera.project(points)[0], *camera.project_with_jacobians(points)[1]

    with torch.autocast("cuda", torch.float16):
        results = camera.project(points)[0], *camera.project_with_jacobians(points)[1]

    for result, without in zip(results, expected, strict=True):
        assert torch.equal(result, without)


@on_every_device
def test_without_its_check_a_camera_does_not_wait(draw, lens, device):
    camera, points = scene(draw, lens, "glass wall", "ordinary")
    camera, points = camera.to(device=device), points.to(device)
    camera.project(points)

    with without_waiting(device):
        camera[1:].project(points[1:])
        camera.project_with_jacobians(points)


def _as(dtype, camera, values):
    return camera.to(dtype=dtype), values.to(dtype)
