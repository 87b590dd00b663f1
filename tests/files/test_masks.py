"""What may be used of photographs: masks by their names, alpha, and what is said of masks that fit nothing."""

import re

import cv2
import numpy as np
import pytest
import torch

from torchrefrac import load_capture
from torchrefrac.files.masks import Masks
from torchrefrac.scene import CaptureError

HEIGHT, WIDTH = 48, 64


@pytest.fixture
def half():
    """Used is the left half."""
    return torch.arange(WIDTH).expand(HEIGHT, WIDTH) < WIDTH // 2


@pytest.fixture
def write_mask():
    """Writes masks/NAME into the folder of a capture."""

    def write(folder, name, used):
        path = folder / "masks" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), used.byte().numpy() * 255)
        return path

    return write


def test_without_masks_all_may_be_used(write_capture):
    masks = Masks(load_capture(write_capture()))

    assert not masks.hide_something
    assert [masks.used(i) for i in range(2)] == [None, None]


@pytest.mark.parametrize("name", ["b.png", "b.png.png"])
def test_black_is_not_used(write_capture, write_mask, half, name):
    folder = write_capture()
    write_mask(folder, name, half)

    masks = Masks(load_capture(folder))

    assert masks.hide_something
    assert masks.used(0) is None
    assert torch.equal(masks.used(1), half)


def test_a_white_mask_is_none(write_capture, write_mask, half):
    folder = write_capture()
    write_mask(folder, "b.png", torch.ones_like(half))

    assert not Masks(load_capture(folder)).hide_something


def test_what_is_wholly_transparent_is_not_used_nor_what_is_black_besides(write_capture, write_mask, half):
    folder = write_capture()
    low = torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH) < HEIGHT // 2
    image = np.full((HEIGHT, WIDTH, 4), 9, dtype=np.uint8)
    image[..., 3] = low.numpy()
    cv2.imwrite(str(folder / "images" / "b.png"), image)

    assert torch.equal(Masks(load_capture(folder)).used(1), low)

    write_mask(folder, "b.png", half)

    assert torch.equal(Masks(load_capture(folder)).used(1), low & half)


def test_a_mask_that_fits_no_image_is_named(write_capture, write_mask, half):
    folder = write_capture()
    write_mask(folder, "a.png", half)
    path = write_mask(folder, "bb.png", half)

    wanted = f"{path} fits no image of capture.json; that of b.png must be masks/b.png.png or masks/b.png"
    with pytest.raises(CaptureError, match=re.escape(wanted)):
        load_capture(folder)


def test_a_mask_that_is_no_png_fits_no_image(write_capture, write_mask, half):
    folder = write_capture()
    write_mask(folder, "a.jpg", half)

    with pytest.raises(CaptureError, match=r"a.jpg fits no image of capture.json; that of a.png must be"):
        load_capture(folder)


def test_masks_of_photographs_that_are_not_listed_are_no_mistake(write_capture, write_mask, half):
    """Where these lie in images/, or where all that are listed have masks."""
    folder = write_capture()
    write_mask(folder, "c.png", half)
    cv2.imwrite(str(folder / "images" / "c.jpg"), half.byte().numpy())
    load_capture(folder)

    (folder / "images" / "c.jpg").unlink()
    for name in ("a.png", "b.png"):
        write_mask(folder, name, half)

    load_capture(folder)


def test_files_that_are_no_pictures_are_no_masks(write_capture, write_mask, half):
    folder = write_capture()
    write_mask(folder, "a.png", half)
    for name in (".DS_Store", "._a.png", "Thumbs.db", "notes.txt"):
        (folder / "masks" / name).write_bytes(b"")

    load_capture(folder)


def test_two_masks_of_one_image_are_named(write_capture, write_mask, half):
    folder = write_capture()
    path = write_mask(folder, "b.png.png", half)
    write_mask(folder, "b.png", ~half)

    with pytest.raises(CaptureError, match=re.escape(f"b.png has two masks, {path} and b.png; delete the one that")):
        load_capture(folder)


def test_a_mask_of_another_size_is_named(write_capture, write_mask, half):
    folder = write_capture()
    path = write_mask(folder, "b.png", half[:40])

    with pytest.raises(CaptureError, match=re.escape(f"{path} is 64x40, but the images are 64x48; give it their size")):
        load_capture(folder)


def test_a_mask_that_is_no_image_is_named(write_capture, write_mask, half):
    folder = write_capture()
    path = write_mask(folder, "b.png", half)
    path.write_bytes(b"nothing")

    with pytest.raises(CaptureError, match=re.escape(f"{path} cannot be read as an image")):
        load_capture(folder)
