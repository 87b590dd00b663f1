"""The rays of a whole image at once."""

from dataclasses import replace

import pytest
import torch

from tests.camera.camera_scenes import COUNT, for_every_interface, scene
from tests.tolerances import assert_matches, assert_same_pixels
from torchrefrac.camera import Intrinsics

TINY = (6, 8)  # rows and columns


@for_every_interface
def test_rays_of_an_image_are_those_of_its_pixel_centres(draw, name):
    camera, _ = scene(draw, _tiny(), name, "ordinary")

    rays = camera.rays()

    assert [ray.shape for ray in rays] == [(COUNT, *TINY, 3), (COUNT, *TINY, 3), (COUNT, *TINY)]
    for row, column in ((0, 0), (0, 7), (5, 0), (2, 3)):
        centre = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64)
        for ray, expected in zip(rays, camera.cast_rays(centre), strict=True):
            torch.testing.assert_close(ray[:, row, column], expected, rtol=0.0, atol=1e-13)


@for_every_interface
def test_points_on_the_rays_of_an_image_project_to_its_pixel_centres(draw, name):
    camera, _ = scene(draw, _tiny(), name, "ordinary")
    origins, directions, met = camera.rays()

    pixels, valid = camera[..., None, None].project(origins + 0.7 * directions)

    assert met.any()
    assert valid[met].all()
    assert_same_pixels(pixels[met], camera.intrinsics.pixel_grid().expand_as(pixels)[met])


def test_one_camera_has_the_rays_of_one_image(make_camera):
    assert [ray.shape for ray in make_camera(intrinsics=_tiny()).rays()] == [(*TINY, 3), (*TINY, 3), TINY]


def test_a_batch_of_any_shape_has_as_many_images(draw, make_camera):
    camera = make_camera(2, 3, intrinsics=_tiny())

    rays = camera.rays(2, 5)

    assert [ray.shape for ray in rays] == [(2, 3, 2, 5, 3), (2, 3, 2, 5, 3), (2, 3, 2, 5)]
    for ray, alone in zip(rays, camera[1, 2].rays(2, 5), strict=True):
        torch.testing.assert_close(ray[1, 2], alone, rtol=0.0, atol=1e-13)


def test_cameras_that_differ_only_in_their_lens_have_images_of_their_own(draw, make_camera):
    lens = _tiny()
    camera = make_camera(intrinsics=replace(lens, focal=lens.focal + draw.uniform(0.0, 1.0, 3, 1)))

    _, directions, _ = camera.rays()

    assert directions.shape == (3, *TINY, 3)
    assert_matches(directions[2], camera[2].rays()[1])
    assert (directions[2] - directions[0]).abs().max() > 1e-4


def test_half_the_resolution_covers_the_same_image(make_camera):
    camera = make_camera(intrinsics=_tiny())

    origins, directions, _ = camera.rays(3, 4)

    between = camera.cast_rays(torch.tensor([[1.0, 1.0], [7.0, 5.0]], dtype=torch.float64))  # corners of four pixels
    for rays, expected in zip((origins, directions), between, strict=False):
        assert_matches(rays[0, 0], expected[0])
        assert_matches(rays[-1, -1], expected[1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rays_are_of_the_dtype_of_the_camera(make_camera, dtype):
    origins, directions, valid = make_camera(2, intrinsics=_tiny()).to(dtype=dtype).rays()

    assert origins.dtype == directions.dtype == dtype
    assert valid.dtype == torch.bool


def test_rays_in_single_precision_are_those_in_double(make_camera):
    camera = make_camera(2, intrinsics=_tiny(), max_tilt_deg=20.0)

    for ray, expected in zip(camera.to(dtype=torch.float32).rays()[:2], camera.rays()[:2], strict=True):
        assert_matches(ray, expected.float())


def _tiny():
    rows, columns = TINY
    return Intrinsics.create(columns, rows, 7.2, (4.1, 2.9), (-0.12, 0.06, 0.002, -0.003, -0.01))
