"""Intrinsics."""

import math
from dataclasses import replace

import pytest
import torch

from tests.tolerances import assert_matches, assert_same_pixels
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


@pytest.mark.parametrize(
    "distortion",
    [(-0.28, 0.11, 0.0004, -0.0003, -0.02), (0.2, 0.1, 0.0, 0.0, 0.02), (-0.05, 0.01, 0.01, -0.02, 0.0)],
    ids=["barrel", "pincushion", "decentred"],
)
@pytest.mark.parametrize("focal", [(900.0, 910.0), (700.0, 650.0)])
def test_strong_but_calibrated_lenses_are_undone_over_the_whole_image(distortion, focal):
    lens = Intrinsics.create(1000, 800, focal, (510.0, 390.0), distortion)
    corners = torch.tensor([[0.0, 0.0], [1000.0, 0.0], [0.0, 800.0], [1000.0, 800.0]], dtype=torch.float64)

    for pixels in (lens.pixel_grid(160, 200), corners):
        assert_same_pixels(lens.pixels_from_plane(lens.plane_from_pixels(pixels)), pixels)


def test_every_camera_of_a_batch_has_a_lens_of_its_own(draw, lens, make_pixels):
    lenses = Intrinsics(
        1000,
        800,
        draw.uniform(800.0, 900.0, 3, 2),
        draw.uniform(380.0, 520.0, 3, 2),
        0.02 * draw.uniform(-1.0, 1.0, 3, 5),
    )
    pixels = make_pixels(7)

    plane = lenses.indexed((slice(None), None), (3,)).plane_from_pixels(pixels)

    assert lenses.shape == (3,)
    assert plane.shape == (3, 7, 2)
    alone = lenses.indexed(2, (3,))
    assert alone.shape == ()
    assert_matches(plane[2], alone.plane_from_pixels(pixels))


def test_a_lens_that_all_cameras_share_stays_shared(lens):
    part = lens.indexed(2, (3,))

    assert part.shape == lens.shape == ()
    assert part.focal is lens.focal


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("focal", (3,), r"focal has shape \(3,\), but must end in \(2,\)"),
        ("focal", (), r"focal has shape \(\), but must end in \(2,\)"),
        ("principal_point", (2, 1), r"principal_point has shape \(2, 1\), but must end in \(2,\)"),
        ("distortion", (4,), r"distortion has shape \(4,\), but must end in 0, 5 or 8 numbers"),
    ],
)
def test_parameters_of_a_wrong_shape_are_refused(lens, name, shape, message):
    with pytest.raises(ValueError, match=message):
        replace(lens, **{name: torch.zeros(shape)})


@pytest.mark.parametrize(("width", "height"), [(0, 480), (640, 0), (-1, 480)])
def test_an_image_without_pixels_is_refused(width, height):
    with pytest.raises(ValueError, match=rf"width and height are {width} and {height}, but must be at least 1 pixel"):
        Intrinsics.create(width, height, 500.0)


def test_parameters_that_do_not_fit_each_other_are_refused_with_their_shapes(lens):
    with pytest.raises(ValueError, match=r"do not broadcast: focal \(3,\), principal_point \(\), distortion \(4,\)"):
        replace(lens, focal=torch.ones(3, 2), distortion=torch.zeros(4, 5))


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0, -900.0])
def test_a_focal_length_that_is_none_is_refused(lens, bad):
    with pytest.raises(ValueError, match=r"^focal is .* somewhere, but must be finite and above 0$"):
        Intrinsics.create(640, 480, bad)
    with pytest.raises(ValueError, match=r"^focal is .* somewhere, but must be finite and above 0$"):
        replace(lens, focal=torch.tensor([900.0, bad], dtype=torch.float64))
    assert not replace(lens, focal=torch.tensor([900.0, bad]), check=False).focal.equal(lens.focal)


@pytest.mark.parametrize("name", ["principal_point", "distortion"])
def test_values_that_are_not_finite_are_refused_by_name(lens, name):
    with pytest.raises(ValueError, match=f"^{name} is nan somewhere, but must be finite$"):
        replace(lens, **{name: torch.full_like(getattr(lens, name), math.nan)})


def test_whole_numbers_are_refused_by_name(lens):
    with pytest.raises(ValueError, match=r"^focal has dtype torch\.int64"):
        replace(lens, focal=torch.tensor([900, 900]))


def test_a_pixel_that_is_no_number_lies_outside(lens):
    pixels = torch.tensor([[math.nan, 5.0], [5.0, math.nan], [math.inf, 5.0], [5.0, 5.0]])

    assert lens.contains(pixels).tolist() == [False, False, False, True]


def test_the_grid_holds_the_centre_of_every_pixel():
    grid = Intrinsics.create(3, 2, 1.0).pixel_grid()

    assert grid.shape == (2, 3, 2)
    assert grid[..., 0].tolist() == [[0.5, 1.5, 2.5]] * 2
    assert grid[..., 1].tolist() == [[0.5] * 3, [1.5] * 3]


def test_each_pixel_of_a_grid_of_half_the_size_is_the_middle_of_four(lens):
    half = lens.pixel_grid(400, 500)

    four = lens.pixel_grid().reshape(400, 2, 500, 2, 2).mean(dim=(1, 3))
    assert torch.equal(half, four)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (7, 3), (1600, 2000)])
def test_a_grid_of_any_size_covers_the_image_evenly(lens, rows, columns):
    grid = lens.pixel_grid(rows, columns)

    assert grid.shape == (rows, columns, 2)
    size = torch.tensor([lens.width / columns, lens.height / rows], dtype=torch.float64)
    assert_matches(grid[0, 0], size / 2.0)
    assert_matches(grid[-1, -1], torch.tensor([lens.width, lens.height]) - size / 2.0)
    assert_matches(grid.mean(dim=(0, 1)), torch.tensor([500.0, 400.0], dtype=torch.float64), slack=10.0)
    assert lens.contains(grid).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_grid_is_of_the_dtype_of_the_lens(lens, dtype):
    assert lens.to(dtype=dtype).pixel_grid(2, 2).dtype == dtype


def test_one_side_of_the_grid_may_be_left_as_the_image_is(lens):
    assert lens.pixel_grid(height=7).shape == (7, 1000, 2)
    assert lens.pixel_grid(width=7).shape == (800, 7, 2)


def test_a_grid_without_rows_or_columns_is_refused(lens):
    for size in ((0, 5), (5, 0), (-1, 5)):
        with pytest.raises(ValueError, match=r"height|width"):
            lens.pixel_grid(*size)


def test_only_a_distortion_of_zeros_can_be_left_out(draw):
    xy = draw.uniform(-0.6, 0.6, 30, 2)
    zero, some = Intrinsics.create(640, 480, 500.0), Intrinsics.create(640, 480, 500.0, distortion=(0, 0, 0, 0.01, 0))
    wide = Intrinsics.create(640, 480, 500.0, model="fisheye")

    plain = zero.without_idle_distortion()

    assert plain.distortion.shape == (0,)
    assert torch.equal(plain.pixels_from_plane(xy), zero.pixels_from_plane(xy))
    assert torch.equal(plain.plane_from_pixels(300.0 * xy), zero.plane_from_pixels(300.0 * xy))
    assert some.without_idle_distortion() is some
    assert wide.without_idle_distortion() is wide
