"""Photographs as their files hold them: pixels of 8 bits, how opaque they are, and whether a file is whole."""

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from torchrefrac.scene.capture import CaptureError

JPEG, PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
COLOR_TYPE = 25  # the byte of a PNG file that tells what its pixels are
WITH_ALPHA = (b"\x03", b"\x04", b"\x06")  # palettes, greys and colours
MARKER = re.compile(rb"\xff+([\x01-\xcf\xd8-\xfe])")  # of JPEG, but those that restart the decoder
END_OF_IMAGE, START_OF_SCAN, ALONE = 0xD9, 0xDA, (0x01, 0xD8)
BETWEEN_SCANS = (0xC4, 0xCC, START_OF_SCAN, 0xDB, 0xDC, 0xDD, 0xFE)  # tables, comments and the next scan
RARE = 0.001  # share of the numbers at either end of their range that may be lost when the rest is stretched


class DamagedPhotographError(CaptureError):
    """The file of a photograph is not whole, or nothing that can be read as one; the message names it."""


def read_grey(path: Path) -> cv2.typing.MatLike:
    """8-bit grey image (height, width), as stored: no EXIF rotation. One of 16 bits is stretched as by `read_color`."""
    image = _read(path, cv2.IMREAD_GRAYSCALE)
    return image if image.dtype == np.uint8 else cv2.cvtColor(read_color(path), cv2.COLOR_BGR2GRAY)


def read_color(path: Path) -> cv2.typing.MatLike:
    """8-bit BGR image (height, width, 3), as stored: no EXIF rotation.

    Of 16 bits the range that is in use becomes that of 8, the same for all channels: cameras of 12 bits write 12 of 16.
    """
    image = _read(path, cv2.IMREAD_COLOR)
    return image if image.dtype == np.uint8 else _stretched(image)


def read_alpha(path: Path) -> cv2.typing.MatLike | None:
    """How opaque each pixel is (height, width), 0: not at all; None where the file does not say so."""
    with path.open("rb") as file:
        start = file.read(COLOR_TYPE + 1)
    is_png = start.startswith(PNG) and start[COLOR_TYPE:] in WITH_ALPHA
    is_webp = start.startswith(b"RIFF") and start[8:12] == b"WEBP"
    if not (is_png or is_webp or start.startswith(TIFF)):
        return None
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return None if image is None or image.ndim < 3 or image.shape[2] != 4 else image[..., 3]


def check_photograph(path: Path) -> None:
    """Refuse a JPEG or PNG file that ends too early or is damaged, of which decoders make up the rest in silence (a
    DamagedPhotographError), and a TIFF file of floating-point numbers."""
    content = path.read_bytes()
    problem = ""
    if content.startswith(JPEG):
        problem = _problem_of_jpeg(content)
    elif content.startswith(PNG):
        problem = _problem_of_png(content)
    elif content.startswith(TIFF):
        _require_depth(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), path)
    if problem:
        raise DamagedPhotographError(f"{path} is damaged: {problem}; copy it again from where it was taken")


def _read(path: Path, flags: int) -> cv2.typing.MatLike:
    try:
        image = cv2.imread(str(path), flags | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise DamagedPhotographError(f"{path} cannot be read as an image: {error.err}") from None
    return _require_depth(image, path)


def _require_depth(image: cv2.typing.MatLike | None, path: Path) -> cv2.typing.MatLike:
    if image is None:
        raise DamagedPhotographError(f"{path} cannot be read as an image; is it a complete JPEG, PNG or TIFF file?")
    if image.dtype.name not in ("uint8", "uint16"):
        raise CaptureError(f"{path} holds numbers of type {image.dtype}; convert it to a PNG or TIFF of 8 or 16 bits")
    return image


def _stretched(image: cv2.typing.MatLike) -> UInt8[np.ndarray, "..."]:
    """8 bits of 16; a range of fewer than 256 steps is not stretched, for there is nothing in between."""
    numbers = image.astype(np.uint16, copy=False)
    up_to = np.bincount(numbers.ravel(), minlength=1 << 16).cumsum()
    low, high = np.searchsorted(up_to, (RARE * image.size, (1.0 - RARE) * image.size))
    steps = (np.arange(1 << 16) - float(low)) * (255.0 / max(float(high - low), 255.0))
    return np.take(steps.clip(0.0, 255.0).round().astype(np.uint8), numbers)


def _problem_of_jpeg(content: bytes) -> str:
    """What is wrong with the markers that lead from the start of a JPEG file to its end; nothing where all is well."""
    at, in_scan = len(JPEG), False
    while (marker := MARKER.search(content, at)) is not None:
        kind, at = marker[1][0], marker.end()
        if kind == END_OF_IMAGE:
            return "" if in_scan else "it ends without an image"
        if in_scan and kind not in BETWEEN_SCANS:
            return f"there is something else in the middle of its image, at byte {marker.start()}"
        in_scan |= kind == START_OF_SCAN
        at += 0 if kind in ALONE else int.from_bytes(content[at : at + 2], "big")
    return "it ends before its image does"


def _problem_of_png(content: bytes) -> str:
    """What is wrong with the chunks of a PNG file; nothing where all is well."""
    at = len(PNG)
    while at + 12 <= len(content):
        kind, end = content[at + 4 : at + 8], at + 8 + int.from_bytes(content[at : at + 4], "big")
        is_critical = kind[:1].isupper()
        if is_critical and zlib.crc32(content[at + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            return "it ends before its image does" if end + 4 > len(content) else f"the checksum at byte {end} is wrong"
        if kind == b"IEND":
            return ""
        at = end + 4
    return "it ends before its image does"
