"""Photographs and masks as the dense stage reads them, and what it says about those it cannot use."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from tests.dense.rendered_captures import write_capture, write_mask
from tests.dense.rendered_scenes import Rendered, cameras_around
from torchrefrac.dense.images import Images
from torchrefrac.scene import Cameras, CaptureError

NAMES = ("left/a.b.png", "right.png")


@pytest.fixture
def capture(tmp_path, draw):
    """Two photographs of noise."""
    images = draw.uniform(0.0, 255.0, 2, 120, 160).round().float()
    nothing = torch.zeros(2, 120, 160, 3, dtype=torch.float64)
    rendered = Rendered(cameras_around(2, 30.0, -30.0, 1.33), images, nothing, nothing)
    return write_capture(rendered, tmp_path, NAMES)


@pytest.fixture
def half():
    """Allowed is the left half."""
    return torch.arange(160).expand(120, 160) < 80


def test_grey_values_are_those_of_the_file(capture):
    images = Images(capture)

    stored = cv2.imread(str(capture.paths[1]), cv2.IMREAD_GRAYSCALE)

    assert stored is not None
    assert images.size(0) == (120, 160)
    assert images.grey(1).dtype == torch.uint8
    assert images.grey(1).numpy().tolist() == stored.tolist()


def test_colours_are_red_green_blue_at_their_pixels(capture):
    picture = np.zeros((120, 160, 3), dtype=np.uint8)
    picture[7, 3] = (10, 20, 30)  # OpenCV's order: blue, green, red
    cv2.imwrite(str(capture.paths[1]), picture)

    colors = Images(capture).colors(
        torch.tensor([1, 1, 1]), torch.tensor([[3.0, 7.0], [3.99, 7.99], [4.0, 7.5]]).double()
    )

    assert colors.dtype == torch.uint8
    assert colors.tolist() == [[30, 20, 10], [30, 20, 10], [0, 0, 0]]


def test_without_masks_everything_is_allowed(capture):
    images = Images(capture)

    images.check()

    assert not images.has_masks
    assert images.allowed(0).all()
    assert images.allowed(0).shape == (120, 160)


@pytest.mark.parametrize("name", ["left/a.b.png.png", "left/a.b.png"])
def test_a_mask_has_the_name_of_its_image_with_or_without_its_ending(capture, half, name):
    write_mask(capture, name, half)

    images = Images(capture)
    images.check()

    assert images.has_masks
    assert torch.equal(images.allowed(0), half)
    assert images.allowed(1).all()


def test_two_masks_of_one_image_are_refused(capture, half):
    write_mask(capture, "right.png.png", half)
    write_mask(capture, "right.png", ~half)

    with pytest.raises(CaptureError, match=r"right.png has two masks"):
        Images(capture)


def test_what_is_wholly_transparent_is_not_allowed(capture, half):
    grey = cv2.imread(str(capture.paths[1]))
    cv2.imwrite(str(capture.paths[1]), np.dstack((grey, half.byte().numpy() * 255)))

    images = Images(capture)
    images.check()

    assert images.has_masks
    assert torch.equal(images.allowed(1), half)
    assert images.allowed(0).all()


def test_every_grey_of_a_mask_but_black_is_allowed(capture, half):
    write_mask(capture, "right.png", half)
    path = capture.folder / "masks" / "right.png"
    cv2.imwrite(str(path), np.where(half.numpy(), 1, 0).astype(np.uint8))

    assert torch.equal(Images(capture).allowed(1), half)


def test_a_missing_photograph_is_named(capture):
    capture.paths[1].unlink()

    with pytest.raises(CaptureError, match=re.escape(f"{capture.paths[1]} does not exist any more, but")):
        Images(capture).check()


def test_an_unreadable_photograph_is_named(capture):
    capture.paths[0].write_bytes(b"no image")

    with pytest.raises(CaptureError, match=re.escape(f"{capture.paths[0]} cannot be read as an image")):
        Images(capture).check()


def test_a_photograph_of_another_size_is_named(capture):
    narrow = Cameras.of([replace(capture.cameras[0], width=150)])

    with pytest.raises(CaptureError, match=re.escape(f"{capture.paths[0]} is 160x120, but the images are 150x120")):
        Images(replace(capture, cameras=narrow)).check()


def test_a_mask_of_another_size_is_named(capture, half):
    write_mask(capture, "right.png", half[:100])
    path = capture.folder / "masks" / "right.png"

    with pytest.raises(CaptureError, match=re.escape(f"{path} is 160x100, but the images are 160x120; give it")):
        Images(capture).check()


def test_photographs_are_read_once_while_they_are_remembered(capture):
    images = Images(capture, remembered=1)
    first = images.grey(0)

    assert images.grey(0) is first
    images.grey(1)
    assert images.grey(0) is not first
    assert torch.equal(images.grey(0), first)


def test_interest_points_are_found_part_by_part_each_once(capture, monkeypatch):
    """Far from the borders of parts they are those of the whole image; none comes twice."""
    whole = Images(capture).interest_points(0).pixels
    monkeypatch.setattr("torchrefrac.dense.images.PART", 64)

    parts = Images(capture).interest_points(0).pixels

    assert len(parts.unique(dim=0)) == len(parts)
    assert len(whole) > 20
    found_again = torch.cdist(whole, parts).amin(dim=1) < 0.5
    assert found_again.double().mean() > 0.8
