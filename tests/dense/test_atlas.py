"""The atlas against sampling written out for one place in one image."""

import math

import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.dense.atlas import MARGIN, Atlas, pyramid

SIZES = [(31, 47), (24, 20), (37, 37), (12, 55)]  # height, width
ORIGIN = torch.tensor([(0.0, 0.0), (8.0, 4.0), (300.0, 16.0), (12.0, 1000.0)], dtype=torch.float64)
LEVELS = 3


@pytest.fixture
def images(draw):
    return [draw.uniform(0.0, 255.0, *size) for size in SIZES]


def _places(draw, count, level, beyond):
    """Images (count), and pixels (count, 5, 2) in them: up to `beyond` pixels of the copy outside of it."""
    image = torch.arange(count) % len(SIZES)
    size = torch.tensor([(w, h) for h, w in SIZES], dtype=torch.float64)[image]
    room = beyond * 2.0 ** level[:, None]
    share = draw.uniform(0.0, 1.0, count, 5, 2)
    return image, ORIGIN[image, None] - room[:, None] + share * (size + 2.0 * room)[:, None]


def _value(copy, place, kernel, reach):
    """Of one place (2) in a copy (h, w), whose first pixel has its centre at (0.5, 0.5)."""
    (x, y), (h, w) = place.tolist(), copy.shape
    left, top = math.floor(x - 0.5), math.floor(y - 0.5)
    total = 0.0
    for row in range(top - reach + 1, top + reach + 1):
        for column in range(left - reach + 1, left + reach + 1):
            weight = kernel(x - 0.5 - column) * kernel(y - 0.5 - row)
            total += weight * float(copy[min(max(row, 0), h - 1), min(max(column, 0), w - 1)])
    return total


def _tent(t):
    return max(1.0 - abs(t), 0.0)


def _cubic(t):
    """Keys' kernel with a = -3/4."""
    t = abs(t)
    if t <= 1.0:
        return 1.25 * t**3 - 2.25 * t**2 + 1.0
    return -0.75 * (t**3 - 5.0 * t**2 + 8.0 * t - 4.0) if t < 2.0 else 0.0


@pytest.mark.parametrize(
    ("mode", "kernel", "reach", "beyond"),
    [("bilinear", _tent, 1, MARGIN - 0.5), ("bicubic", _cubic, 2, MARGIN - 1.5)],
)
def test_every_place_of_every_copy_has_the_value_that_the_copy_alone_gives(draw, images, mode, kernel, reach, beyond):
    atlas = Atlas.build(images, LEVELS, ORIGIN, mode)
    level = torch.arange(60) // 4 % LEVELS
    image, pixels = _places(draw, 60, level, beyond)

    values = atlas.sample(image, level, pixels)

    copies = [pyramid(part, LEVELS) for part in images]
    expected = [
        [_value(copies[i][k], (pixel - ORIGIN[i]) / 2**k, kernel, reach) for pixel in pixels[row]]
        for row, (i, k) in enumerate(zip(image.tolist(), level.tolist(), strict=True))
    ]
    assert_matches(values, torch.tensor(expected, dtype=torch.float64), slack=10.0)


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_no_image_bleeds_into_its_neighbours_on_the_sheet(draw, mode):
    grey = 10.0 ** torch.arange(len(SIZES))
    atlas = Atlas.build(
        [torch.full(size, float(g)).double() for size, g in zip(SIZES, grey, strict=True)], LEVELS, ORIGIN, mode
    )
    level = torch.arange(600) // 4 % LEVELS
    image, pixels = _places(draw, 600, level, beyond=0.5)

    values = atlas.sample(image, level, pixels)

    torch.testing.assert_close(values, grey.double()[image, None].expand(600, 5), rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_slopes_are_the_differences_of_the_values(draw, images, mode):
    atlas = Atlas.build(images, LEVELS, ORIGIN, mode)
    level = torch.arange(200) // 4 % LEVELS
    image, pixels = _places(draw, 200, level, beyond=0.0)

    places, per_pixel = atlas.locate(image, level, pixels)
    values, slopes = atlas.sample_with_slopes(places)

    slopes = slopes * per_pixel
    assert torch.equal(values, atlas.sample(image, level, pixels))
    step = 1e-6
    for axis in range(2):
        shift = step * torch.eye(2, dtype=torch.float64)[axis]
        differences = atlas.sample(image, level, pixels + shift) - atlas.sample(image, level, pixels - shift)
        torch.testing.assert_close(slopes[..., axis], differences / (2.0 * step), rtol=1e-6, atol=1e-5)


def test_a_ramp_stays_the_same_ramp_in_smaller_copies_of_any_size():
    """Of odd height and width at each size; away from the border, where the copies are smoothed with what is beyond."""
    size, slope, origin = (71, 91), torch.tensor([1.5, -0.7], dtype=torch.float64), torch.tensor([[8.0, 16.0]])
    y, x = torch.meshgrid(torch.arange(size[0]) + 0.5, torch.arange(size[1]) + 0.5, indexing="ij")
    ramp = (torch.stack((x, y), dim=-1).double() + origin.double()) @ slope
    atlas = Atlas.build([ramp], LEVELS, origin)
    pixels = origin.double() + torch.tensor([(20.0, 20.0), (45.3, 30.1), (61.7, 47.2), (33.0, 50.9)]).double()

    for level in range(LEVELS):
        values = atlas.sample(torch.zeros(4, dtype=torch.long), torch.full((4,), level), pixels[:, None])

        assert_matches(values[:, 0], pixels @ slope, slack=10.0)


def test_copies_are_half_as_large_as_the_one_before_and_odd_sizes_round_up(draw):
    copies = pyramid(draw.uniform(0.0, 1.0, 37, 50), 4)

    assert [tuple(copy.shape) for copy in copies] == [(37, 50), (19, 25), (10, 13), (5, 7)]


def test_a_place_is_contained_where_it_is_half_a_pixel_from_the_border_of_its_copy(draw, images):
    atlas = Atlas.build(images, LEVELS, ORIGIN)
    level = torch.arange(900) // 4 % LEVELS
    image, pixels = _places(draw, 900, level, beyond=1.0)
    near_one, five = pixels[:, :1], pixels

    inside_one, inside_five = atlas.contains(image, level, near_one), atlas.contains(image, level, five)

    def expected(row, pixel):
        shrink = 2.0 ** int(level[row])
        x, y = ((pixel - ORIGIN[image[row]]) / shrink).tolist()
        h, w = (math.ceil(n / shrink) for n in SIZES[int(image[row])])
        return 0.5 < x < w - 0.5 and 0.5 < y < h - 0.5

    assert inside_one.tolist() == [expected(row, near_one[row, 0]) for row in range(900)]
    assert inside_five.tolist() == [all(expected(row, pixel) for pixel in five[row]) for row in range(900)]
    assert 0.1 < inside_five.double().mean() < inside_one.double().mean() < 0.9


def test_copies_come_off_the_sheet_as_they_were_put_on_it(images):
    atlas = Atlas.build(images, LEVELS, ORIGIN)

    assert atlas.levels == LEVELS
    for i, image in enumerate(images):
        assert torch.equal(atlas.copy(i), image)
        for level, copy in enumerate(pyramid(image, LEVELS)):
            assert torch.equal(atlas.copy(i, level), copy)


def test_values_are_differentiable_in_pixels_and_images(draw):
    images = [draw.uniform(0.0, 1.0, 9, 7).requires_grad_(), draw.uniform(0.0, 1.0, 6, 8).requires_grad_()]
    image, level = torch.tensor([0, 1, 0, 1]), torch.tensor([0, 0, 1, 1])
    pixels = draw.uniform(1.0, 5.0, 4, 3, 2).requires_grad_()

    def sample(pixels, *images):
        return Atlas.build(images, 2).sample(image, level, pixels)

    assert torch.autograd.gradcheck(sample, (pixels, *images))


@pytest.mark.parametrize("count", [1, 2, 7, 23])
def test_no_two_copies_overlap_on_a_sheet_that_is_mostly_full(draw, count):
    images = [torch.zeros(int(h), int(w)) for h, w in draw.uniform(40.0, 90.0, count, 2)]

    atlas = Atlas.build(images, LEVELS)

    taken = torch.zeros(atlas.sheet.shape[-2:])
    for (x, y), (w, h) in zip(
        atlas.offset.view(-1, 2).long().tolist(), atlas.size.view(-1, 2).long().tolist(), strict=True
    ):
        taken[y - MARGIN : y + h + MARGIN, x - MARGIN : x + w + MARGIN] += 1.0
    assert float(taken.max()) == 1.0
    assert float(taken.sum()) == sum((h + 2 * MARGIN) * (w + 2 * MARGIN) for w, h in atlas.size.view(-1, 2).tolist())
    assert taken.mean() > 0.6
