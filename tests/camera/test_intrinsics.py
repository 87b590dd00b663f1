"""Intrinsics."""

import torch
from tolerances import assert_matches, assert_same_pixels

from torchrefrac.camera import Intrinsics


def test_one_focal_length_serves_both_axes_and_the_principal_point_is_the_middle():
    intrinsics = Intrinsics.create(640, 480, 500)

    assert intrinsics.focal.tolist() == [500.0, 500.0]
    assert intrinsics.principal_point.tolist() == [320.0, 240.0]
    assert intrinsics.distortion.tolist() == [0.0] * 5
    assert intrinsics.focal.dtype == torch.float64


def test_numbers_that_are_given_are_kept():
    intrinsics = Intrinsics.create(640, 480, (500.0, 510.0), (300.0, 250.0), (0.1, 0.2, 0.3, 0.4, 0.5), torch.float32)

    assert_matches(intrinsics.focal, torch.tensor([500.0, 510.0]))
    assert_matches(intrinsics.principal_point, torch.tensor([300.0, 250.0]))
    assert_matches(intrinsics.distortion, torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5]))


def test_the_image_reaches_from_zero_to_its_size():
    pixels = torch.tensor(
        [[0.0, 0.0], [640.0, 480.0], [0.5, 479.9], [-0.1, 5.0], [5.0, -0.1], [640.1, 5.0], [5.0, 480.1]]
    )

    assert Intrinsics.create(640, 480, 500).contains(pixels).tolist() == [True] * 3 + [False] * 4


def test_the_first_pixels_centre_is_half_a_pixel_inside_the_image():
    intrinsics = Intrinsics.create(2, 2, 1.0)  # the middle of a 2 x 2 image is the corner where its pixels meet

    first = intrinsics.pixels_from_plane(torch.tensor([-0.5, -0.5], dtype=torch.float64))

    assert first.tolist() == [0.5, 0.5]


def test_plane_and_pixels_invert_each_other(lens, make_pixels):
    pixels = make_pixels(3, 100)

    back = lens.pixels_from_plane(lens.plane_from_pixels(pixels))

    assert_same_pixels(back, pixels)


def test_another_dtype_keeps_everything_else(lens):
    single = lens.to(dtype=torch.float32)

    assert (single.width, single.height) == (lens.width, lens.height)
    for name in ("focal", "principal_point", "distortion"):
        assert_matches(getattr(single, name), getattr(lens, name).float())
