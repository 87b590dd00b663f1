"""Photographs together: their cameras, those that are of no use, clocks, and which files are meant."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.files.metadata.made_photographs import write_photograph
from torchrefrac.files.metadata.grouping import camera_names, shared_lens
from torchrefrac.files.metadata.lens import Lens
from torchrefrac.files.metadata.listing import common_folder, list_photographs
from torchrefrac.files.metadata.photograph import read_photograph
from torchrefrac.files.metadata.quality import look_at, useless
from torchrefrac.files.metadata.times import epochs_of, odd_times
from torchrefrac.scene import CaptureError


@pytest.fixture
def photograph(tmp_path):
    """One with a camera that has a name."""
    tags = {"Make": "DJI", "Model": "FC6310", "FocalLength": (88, 10), "BodySerialNumber": "A1"}
    return read_photograph(write_photograph(tmp_path / "a.jpg", tags))


@pytest.mark.parametrize(
    "other",
    [
        {"body": ("DJI", "FC6310", "B2")},
        {"body": ("DJI", "L1D-20c", "A1")},
        {"focal_mm": 12.0},
        {"width": 72, "height": 96},
    ],
)
def test_another_body_lens_or_size_is_another_camera(photograph, other):
    first, second, third = camera_names([photograph, replace(photograph, **other), photograph])

    assert first == third == "FC6310_8.8mm_96x72"
    assert second != first


def test_folders_tell_cameras_apart_where_that_is_wanted(photograph, tmp_path):
    others = [replace(photograph, path=tmp_path / folder / "a.jpg") for folder in ("left", "right", "left")]

    assert camera_names(others, "folder") == ["left_96x72", "right_96x72", "left_96x72"]
    assert len(set(camera_names(others))) == 1


def test_photographs_of_a_camera_share_the_best_lens_that_any_of_them_knows():
    rough = Lens((100.0, 100.0), (48.0, 36.0), (0.0,) * 5, 0.05, "EXIF")
    known = [Lens((focal, focal), (48.0, 36.0), (0.1, 0, 0, 0, 0), 0.01, "XMP") for focal in (81.0, 82.0, 90.0)]

    assert shared_lens([rough, *known]) == replace(known[1], principal_point=(48.0, 36.0))


@pytest.fixture(scope="module")
def series():
    """Five images with detail of every size."""
    images = []
    for i in range(5):
        noise = np.random.default_rng(i).normal(size=(240, 320, 3))
        noise = sum(2.0 * size * cv2.GaussianBlur(noise, (0, 0), size) for size in (1.0, 2.0, 4.0, 8.0, 16.0))
        images.append((128 + 22 * noise).clip(30, 220).astype(np.uint8))
    return images


def _blurred(image, size):
    return cv2.GaussianBlur(image, (0, 0), size)


def _moved(image, pixels):
    return cv2.blur(image, (pixels, 1))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda image: image, ""),
        (lambda image: _blurred(image, 1.0), ""),
        (lambda image: _moved(image, 3), ""),
        (lambda image: cv2.convertScaleAbs(image, alpha=0.4), ""),
        (lambda image: _blurred(image, 6.0), "blurred"),
        (lambda image: _moved(image, 41), "blurred"),
        (lambda image: _moved(image.transpose(1, 0, 2), 41).transpose(1, 0, 2), "blurred"),
        (lambda image: image // 30, "black"),
        (lambda image: 251 + image // 70, "burnt out"),
    ],
)
def test_a_useless_photograph_among_others_has_a_reason(tmp_path, series, change, reason):
    paths = [tmp_path / f"{i}.png" for i in range(5)]
    for i, (path, image) in enumerate(zip(paths, series, strict=True)):
        cv2.imwrite(str(path), change(image) if i == 2 else image)

    reasons = useless(look_at(paths))

    assert reasons[2].startswith(reason)
    assert bool(reasons[2]) == bool(reason)
    assert [*reasons[:2], *reasons[3:]] == [""] * 4


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (("2024:05:17 11:02:33", "2024:05:17 11:02:40"), None),
        (("2024:05:17 11:02:33", "2024:05:17 11:02:32"), None),  # a burst
        (("2024:05:17 11:02:33", "2024:05:17 10:02:40"), "b is earlier than the one before it by 0:59:53"),
        (("1980:01:01 00:00:10", "1980:01:01 00:00:20"), r"a: its clock was not set \(1980\)"),
        (("2024:05:17 11:02:33", "2024:05:20 11:02:40"), "over 3 days"),
        (("", "yesterday"), None),
    ],
)
def test_clocks_that_jump_are_told(times, words):
    notes = odd_times(times, ["a", "b"])

    assert len(notes) == (words is not None)
    if words is not None:
        assert re.search(words, notes[0])


def test_epochs_begin_after_hours_without_photographs():
    times = ["2024:05:17 11:02:33", "2024:05:17 12:00:00", "", "2024:05:18 09:30:00", "2024:05:17 12:30:00"]

    morning, later = "2024-05-17 11:02", "2024-05-18 09:30"
    assert epochs_of(times, 6.0) == [morning, morning, morning, later, morning]
    assert epochs_of(times, 48.0) == epochs_of(["", ""], 6.0) == []


@pytest.fixture
def card(tmp_path):
    """A memory card with two folders of photographs and what else lies on one."""
    for name in ("DCIM/100MEDIA/DJI_0002.JPG", "DCIM/100MEDIA/DJI_0010.JPG", "DCIM/101MEDIA/DJI_0001.JPG"):
        write_photograph(tmp_path / name)
    media = ("DJI_0002.DNG", "DJI_0003.DNG", "DJI_0004.MP4", "._DJI_0002.JPG")
    others = ("DCIM/.Trashes/DJI_0009.JPG", "MISC/IDX/0.idx", "out/images/a.jpg")
    for name in (*(f"DCIM/100MEDIA/{file}" for file in media), *others):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"no picture")
    return tmp_path


def test_a_card_is_read_with_its_folders_in_the_order_of_numbers(card):
    listing = list_photographs([str(card)], card / "out")

    names = [path.relative_to(card).as_posix() for path in listing.pictures]
    assert names == ["DCIM/100MEDIA/DJI_0002.JPG", "DCIM/100MEDIA/DJI_0010.JPG", "DCIM/101MEDIA/DJI_0001.JPG"]
    assert common_folder(listing.pictures) == card / "DCIM"
    assert {path.name: "convert" in reason for path, reason in listing.others.items()} == {
        "DJI_0002.DNG": False,
        "DJI_0003.DNG": True,
    }
    assert [path.name for path in listing.films] == ["DJI_0004.MP4"]


@pytest.mark.parametrize(
    ("sources", "count"),
    [
        (["DCIM/100MEDIA"], 2),
        (["DCIM/100MEDIA", "DCIM"], 3),
        (["DCIM/*/DJI_00?2.JPG"], 1),
        (["DCIM/**/*.JPG"], 3),
        (["DCIM/100MEDIA/DJI_0002.JPG", "DCIM/101MEDIA/DJI_0001.JPG"], 2),
    ],
)
def test_folders_patterns_and_files_are_taken_once(card, monkeypatch, sources, count):
    monkeypatch.chdir(card)

    assert len(list_photographs(sources, card / "out").pictures) == count


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(CaptureError, match=r"photos is .*nowhere, where no file is"):
        list_photographs([str(tmp_path / "nowhere")], tmp_path / "out")
