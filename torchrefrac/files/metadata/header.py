"""What stands at the beginning of an image file: its size, before anything is decoded, and its packet of XMP."""

import struct
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from warnings import catch_warnings, simplefilter

from PIL import Image

from torchrefrac.files.photographs import DamagedPhotographError
from torchrefrac.scene.capture import CaptureError

MOST_PIXELS = 600_000_000  # three times as many as any camera has


class Header(NamedTuple):
    """Size in pixels, as stored, and the packet of XMP, empty without one."""

    width: int
    height: int
    packet: bytes


def read_header(path: Path) -> Header:
    """Raises DamagedPhotographError where it is no image that can be read, CaptureError where its size is that of no
    photograph."""
    try:
        with _without_limits(), Image.open(path) as image:
            width, height = image.size
            packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    except (OSError, ValueError, SyntaxError, struct.error) as error:
        if isinstance(error, FileNotFoundError | PermissionError):
            raise
        wanted = "is it a complete JPEG, PNG or TIFF file?"
        raise DamagedPhotographError(f"{path} cannot be read as an image; {wanted}") from None
    if width * height > MOST_PIXELS:
        wanted = f"photographs have at most {MOST_PIXELS // 1_000_000} million; remove it"
        raise CaptureError(f"{path} says that it has {width}x{height} pixels, but {wanted}")
    return Header(width, height, packet.encode("utf-8") if isinstance(packet, str) else bytes(packet))


@contextmanager
def _without_limits() -> Generator[None]:
    """Without Pillow's own limit, below what some phones take, for nothing is decoded here, and without its warnings of
    tags that are odd."""
    before = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        with catch_warnings():
            simplefilter("ignore")
            yield
    finally:
        Image.MAX_IMAGE_PIXELS = before
