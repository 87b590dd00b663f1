"""Gravity of phones, where the photograph has it. Their compass is not used: metal near by turns it by tens of
degrees."""

import math
import re
import struct

from torchrefrac.files.metadata.attitude import Attitude, as_stored
from torchrefrac.files.metadata.exif import Exif

SIGMA_DEG = 1.0
"""Of a phone's accelerometer: its bias alone makes some tenths of a degree, the hand that presses the button the
rest."""
APPLE, APPLE_HEAD = b"Apple iOS\0", 14  # how its maker note begins, and where its directory of tags does
ACCELERATION, SIGNED_RATIONAL = 8, 10  # the tag, and the kind of its numbers
MOST_OF_GRAVITY = 0.15  # by which a phone that is held still may be off from 1 g
LEAST_UPRIGHT = 0.17  # of gravity along the longer side, to tell in which way a photograph was turned: 10 degrees
ANGLES = re.compile(r"Yaw:?\s*[-+\d.]+[,\s]+Pitch:?\s*([-+]?[\d.]+)[,\s]+Roll:?\s*([-+]?[\d.]+)", re.IGNORECASE)


def gravity_of(exif: Exif, width: int, height: int) -> Attitude | None:
    """Of an iPhone's rear camera, or of a photograph by Open Camera."""
    orientation = int(exif.number("Image Orientation") or 1)
    if exif.text("Image Make").lower() == "apple":
        found = _apple(exif, orientation, is_upright=height > width)
        source = "accelerometer (Apple maker note)"
    else:
        found = _open_camera(exif.text("EXIF UserComment"), orientation)
        source = "angles in the user comment"
    return None if found is None else Attitude(found, None, SIGMA_DEG, source)


def _apple(exif: Exif, orientation: int, is_upright: bool) -> tuple[float, float, float] | None:
    """The vector is gravity in g, in the axes of the device: right, up, out of the screen.

    The sensor's rows run along the longer side of the phone, whichever way that is held: right of the image as stored
    is down the device. A photograph that is stored upright has been turned afterwards, so that down was below.
    """
    axes = _acceleration(exif.maker_note)
    size = math.hypot(*axes)
    if len(axes) != 3 or abs(size - 1.0) > MOST_OF_GRAVITY or "front" in exif.text("EXIF LensModel").lower():
        return None
    x, y, z = (axis / size for axis in axes)
    if not is_upright:
        return (-y, -x, -z)
    if orientation != 1 or abs(y) < LEAST_UPRIGHT:
        return None
    return (x, -y, -z) if y < 0.0 else (-x, y, -z)


def _acceleration(note: bytes) -> tuple[float, ...]:
    """The vector in an iPhone's maker note, whose offsets count from its beginning; empty where there is none.

    ExifRead counts them from elsewhere.
    """
    if not note.startswith(APPLE):
        return ()
    order = ">" if note[APPLE_HEAD - 2 : APPLE_HEAD] == b"MM" else "<"
    try:
        (count,) = struct.unpack_from(f"{order}H", note, APPLE_HEAD)
        for entry in range(APPLE_HEAD + 2, APPLE_HEAD + 2 + 12 * count, 12):
            tag, kind, size, offset = struct.unpack_from(f"{order}HHII", note, entry)
            if (tag, kind, size) == (ACCELERATION, SIGNED_RATIONAL, 3):
                numbers = struct.unpack_from(f"{order}6i", note, offset)
                return tuple(above / below for above, below in zip(numbers[::2], numbers[1::2], strict=True))
    except (struct.error, ZeroDivisionError):
        return ()
    return ()


def _open_camera(comment: str, orientation: int) -> tuple[float, float, float] | None:
    """Pitch is 0 at the horizon, -90 straight down; roll is that of the image as shown, its right side down."""
    found = ANGLES.search(comment)
    if found is None:
        return None
    try:
        pitch, roll = (math.radians(float(angle)) for angle in found.groups())
    except ValueError:
        return None
    shown = (math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch), -math.sin(pitch))
    return as_stored(shown, orientation)
