"""To kornia's pinhole and back: the same pose and lens, in either convention of pixels."""

import pytest
import torch

from tests.tolerances import EXACT, assert_same_pixels
from torchrefrac.camera import Intrinsics, from_kornia, to_kornia
from torchrefrac.refraction import FlatInterface


@pytest.fixture
def straight_lens():
    return Intrinsics.create(1000, 800, (900.0, 910.0), (510.0, 390.0))


@pytest.fixture
def make_camera(make_camera, straight_lens):
    """`make_camera` of the folder, with a lens that has no distortion."""
    return lambda *shape, **options: make_camera(*shape, intrinsics=straight_lens, **options)


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3)])
def test_kornia_projects_what_the_camera_sees_straight_half_a_pixel_lower(make_camera, points_seen, shape):
    camera = make_camera(*shape)
    points = points_seen(camera[..., None], *shape, 5)

    pixels = to_kornia(camera).project(points.reshape(-1, 5, 3))

    assert_same_pixels(pixels.reshape(*shape, 5, 2), camera.as_pinhole()[..., None].project(points)[0] - 0.5)


def test_kornia_knows_the_size_of_the_images(make_camera):
    pinhole = to_kornia(make_camera(3))

    assert pinhole.batch_size == 3
    assert pinhole.height.tolist() == [800.0] * 3
    assert pinhole.width.tolist() == [1000.0] * 3


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3)])
def test_there_and_back_is_the_same_camera(make_camera, points_seen, shape):
    camera = make_camera(*shape)
    points = points_seen(camera, *shape)

    back = from_kornia(to_kornia(camera), camera.interface)

    count = max(1, camera.shape.numel())
    assert back.shape == (count,)
    assert (back.intrinsics.width, back.intrinsics.height) == (1000, 800)
    assert_same_pixels(back.project(points.reshape(count, 3))[0], camera.project(points)[0].reshape(count, 2))


def test_cameras_of_different_lenses_come_back_each_with_its_own(draw, make_camera, points_seen):
    camera = make_camera(4)
    focal, middle = draw.uniform(500.0, 900.0, 4, 2), draw.uniform(300.0, 500.0, 4, 2)
    pinhole = to_kornia(camera)
    pinhole.intrinsics[:, :2, 2] = middle - 0.5
    pinhole.intrinsics[:, 0, 0], pinhole.intrinsics[:, 1, 1] = focal[:, 0], focal[:, 1]

    back = from_kornia(pinhole)

    torch.testing.assert_close(back.intrinsics.focal, focal, rtol=0.0, atol=EXACT.pixel)
    torch.testing.assert_close(back.intrinsics.principal_point, middle, rtol=0.0, atol=EXACT.pixel)
    points = points_seen(camera, 4)
    assert_same_pixels(back.project(points)[0], pinhole.project(points[:, None])[:, 0] + 0.5)


def test_a_pinhole_of_kornia_looks_through_the_interface_it_is_given(make_camera, points_seen):
    camera = make_camera(4)
    points, pinhole = points_seen(camera, 4), to_kornia(camera)

    through, straight = from_kornia(pinhole, FlatInterface(1.333)), from_kornia(pinhole)

    assert_same_pixels(through.project(points)[0], camera.project(points)[0])
    assert_same_pixels(straight.project(points)[0], camera.as_pinhole().project(points)[0])
    assert ((through.project(points)[0] - straight.project(points)[0]).norm(dim=-1) > 1.0).any()


def test_the_gradient_passes_through_kornia(make_camera, points_seen):
    camera = make_camera(4)
    points = points_seen(camera, 4)
    center = camera.center_in_world.clone().requires_grad_()
    moving = type(camera)(camera.intrinsics, camera.cam_from_world_rotation, center, camera.interface)

    there = torch.autograd.grad(to_kornia(moving).project(points[:, None]).sum(), center)[0]
    back = torch.autograd.grad(from_kornia(to_kornia(moving), camera.interface).project(points)[0].sum(), center)[0]

    assert_same_pixels(there, torch.autograd.grad(moving.as_pinhole().project(points)[0].sum(), center)[0])
    assert_same_pixels(back, torch.autograd.grad(moving.project(points)[0].sum(), center)[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_there_and_back_the_dtype_stays(make_camera, dtype):
    camera = make_camera(2).to(dtype=dtype)

    pinhole = to_kornia(camera)

    assert pinhole.intrinsics.dtype == pinhole.extrinsics.dtype == dtype
    assert from_kornia(pinhole).center_in_world.dtype == dtype


def test_a_lens_with_distortion_is_refused(make_camera, lens):
    camera = type(make_camera())(lens, torch.eye(3, dtype=torch.float64), torch.ones(3).double(), FlatInterface())

    with pytest.raises(ValueError, match="camera has lens distortion, but must have none"):
        to_kornia(camera)


@pytest.mark.parametrize("side", ["width", "height"])
def test_images_of_different_sizes_are_refused(make_camera, side):
    pinhole = to_kornia(make_camera(2))
    getattr(pinhole, side)[1] += 1.0

    with pytest.raises(ValueError, match="pinhole has images of different sizes"):
        from_kornia(pinhole)


def test_a_skewed_lens_is_refused(make_camera):
    pinhole = to_kornia(make_camera(2))
    pinhole.intrinsics[1, 0, 1] = 2.0

    with pytest.raises(ValueError, match="pinhole has skewed pixels, but the skew must be 0"):
        from_kornia(pinhole)
