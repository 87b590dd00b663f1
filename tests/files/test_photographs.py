"""Photographs as they are read: 8 bits as they are, 16 stretched, and damaged files named."""

import struct

import cv2
import numpy as np
import pytest

from torchrefrac import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.photographs import check_photograph, read_alpha, read_color, read_grey
from torchrefrac.scene import CaptureError

STORED = cv2.IMREAD_IGNORE_ORIENTATION


@pytest.fixture
def picture(draw):
    """BGR, 8 bits, of every value."""
    return draw.uniform(0.0, 255.999, 48, 64, 3).byte().numpy()


@pytest.fixture
def write(tmp_path):
    """`write(name, array)`: the path of that image."""

    def writer(name, array, *how):
        path = tmp_path / name
        assert cv2.imwrite(str(path), array, how)
        return path

    return writer


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.bmp", "a.webp"])
def test_eight_bits_are_read_as_opencv_reads_them(write, picture, name):
    for array in (picture, picture[..., 0]):
        path = write(name, array)

        assert np.array_equal(read_color(path), cv2.imread(str(path), cv2.IMREAD_COLOR | STORED))
        assert np.array_equal(read_grey(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | STORED))


def test_so_are_the_photographs_of_the_embedded_scene():
    path = embedded_scene("tank_small") / "images" / "cam00.jpg"

    assert np.array_equal(read_color(path), cv2.imread(str(path), cv2.IMREAD_COLOR | STORED))
    assert np.array_equal(read_grey(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | STORED))


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
@pytest.mark.parametrize("factor", [4, 16, 257])
def test_of_sixteen_bits_the_range_in_use_becomes_that_of_eight(write, picture, name, factor):
    """10 and 12 in 16, and all of them."""
    path = write(name, picture.astype(np.uint16) * factor)

    assert read_color(path).dtype == np.uint8
    assert np.abs(read_color(path).astype(int) - picture).max() <= 1
    assert np.array_equal(read_grey(path), cv2.cvtColor(read_color(path), cv2.COLOR_BGR2GRAY))


def test_a_few_hot_pixels_do_not_decide_the_range(write, picture):
    hot = picture.astype(np.uint16) * 16
    hot[7, 5:7] = 65535

    read = read_color(write("a.png", hot))

    assert read[7, 5].tolist() == [255, 255, 255]
    assert np.abs(np.delete(read, 7, axis=0).astype(int) - np.delete(picture, 7, axis=0)).max() <= 1


def test_all_channels_are_stretched_alike(write, picture):
    blue = picture.astype(np.uint16) * 16 // np.array([1, 2, 4], dtype=np.uint16)

    read = read_color(write("a.png", blue)).astype(int)

    assert np.abs(read - picture // np.array([1, 2, 4])).max() <= 1


def test_a_narrow_range_is_stretched_but_no_noise(write):
    ramp = np.linspace(2000, 2400, 640).round().astype(np.uint16).reshape(20, 32)
    noise = 2000 + np.arange(640, dtype=np.uint16).reshape(20, 32) % 4

    assert np.ptp(read_grey(write("a.png", ramp))) == 255
    assert np.ptp(read_grey(write("b.png", noise))) == 3


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_tiff_of_floats_is_refused_with_what_to_convert_it_to(write, picture, dtype):
    numbers = picture.astype(dtype) / 255
    wanted = rf"a.tif holds numbers of type {np.dtype(dtype)}; convert it to a PNG or TIFF of 8 or 16 bits"

    for array in (numbers, numbers[..., 0]):
        with pytest.raises(CaptureError, match=wanted):
            check_photograph(write("a.tif", array))
    with pytest.raises(CaptureError, match=wanted):
        read_grey(write("a.tif", numbers[..., 0]))


def test_alpha_is_read_where_there_is_one(write, picture):
    alpha = picture[..., 0]
    with_alpha = np.dstack((picture, alpha))

    assert np.array_equal(read_alpha(write("a.png", with_alpha)), alpha)
    assert np.array_equal(read_alpha(write("a.tif", with_alpha)), alpha)
    assert np.array_equal(read_alpha(write("b.png", with_alpha.astype(np.uint16) * 257)), alpha.astype(np.uint16) * 257)
    for name in ("c.png", "c.tif", "c.jpg", "c.bmp"):
        assert read_alpha(write(name, picture)) is None


@pytest.mark.parametrize(
    "how", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 3), (cv2.IMWRITE_JPEG_QUALITY, 30)]
)
def test_whole_jpegs_pass_also_with_more_behind_them(write, picture, how):
    path = write("a.jpg", picture, *how)
    check_photograph(path)

    path.write_bytes(path.read_bytes() + b"\0" * 100)

    check_photograph(path)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("name", ["b.jpg", "b.png"])
def test_a_file_that_ends_too_early_is_named(write_capture, picture, name, share):
    folder = write_capture(lambda c: c["images"][1].update(name=name))
    path = folder / "images" / name
    cv2.imwrite(str(path), picture)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])

    with pytest.raises(CaptureError, match=rf"{name} is damaged: it ends before its image does; copy it again"):
        load_capture(folder)


@pytest.mark.parametrize("content", [b"", b"\xff\xd8\xff\xe0 and no more", b"not an image"])
def test_one_that_is_not_whole_among_others_is_left_out(write_capture, picture, content):
    folder = write_capture(lambda c: c["images"].append({**c["images"][1], "name": "c.png", "height": 7.0}))
    (folder / "images" / "c.png").write_bytes((folder / "images" / "b.png").read_bytes())
    (folder / "images" / "b.png").write_bytes(content)

    capture = load_capture(folder)

    assert capture.names == ("a.png", "c.png")
    assert float(capture.height[1]) == 7.0
    assert len(capture.down_in_cam) == len(capture.camera) == 2
    assert list(capture.damaged) == ["b.png"]
    assert "b.png" in capture.damaged["b.png"]


def test_something_else_in_the_middle_of_a_jpeg_is_named(write, picture):
    path = write("a.jpg", picture)
    content = path.read_bytes()
    middle = len(content) // 2
    path.write_bytes(content[:middle] + b"\xff\xe9" + content[middle + 2 :])

    with pytest.raises(CaptureError, match=rf"a.jpg is damaged: there is something else .* at byte {middle};"):
        check_photograph(path)


def test_a_jpeg_without_an_image_is_named(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"\xff\xd8\xff\xd9")

    with pytest.raises(CaptureError, match=r"a.jpg is damaged: it ends without an image"):
        check_photograph(path)


def test_a_changed_byte_of_a_png_is_named_unless_it_is_in_a_comment(write, picture):
    path = write("a.png", picture)
    content = bytearray(path.read_bytes())
    comment = struct.pack(">I", 4) + b"tEXt" + b"a\0bc" + b"\0\0\0\0"
    path.write_bytes(content[:33] + comment + content[33:])
    check_photograph(path)

    content[len(content) // 2] ^= 1
    path.write_bytes(content)

    with pytest.raises(CaptureError, match=r"a.png is damaged: the checksum at byte \d+ is wrong"):
        check_photograph(path)


def test_the_embedded_photographs_are_whole():
    for path in (embedded_scene("tank_small") / "images").iterdir():
        check_photograph(path)
