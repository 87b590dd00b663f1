"""Photographs with the metadata that devices write, made by Pillow."""

import struct
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

IMAGE, CAMERA, GPS = None, 0x8769, 0x8825  # directories of EXIF
TAGS = {
    "Make": (IMAGE, 0x010F), "Model": (IMAGE, 0x0110), "Orientation": (IMAGE, 0x0112), "FocalLength": (CAMERA, 0x920A),
    "FocalLengthIn35mmFilm": (CAMERA, 0xA405), "DigitalZoomRatio": (CAMERA, 0xA404), "MakerNote": (CAMERA, 0x927C),
    "FocalPlaneXResolution": (CAMERA, 0xA20E), "FocalPlaneResolutionUnit": (CAMERA, 0xA210),
    "ExifImageWidth": (CAMERA, 0xA002), "ExifImageLength": (CAMERA, 0xA003), "DateTimeOriginal": (CAMERA, 0x9003),
    "UserComment": (CAMERA, 0x9286), "BodySerialNumber": (CAMERA, 0xA431), "LensModel": (CAMERA, 0xA434),
    "GPSLatitudeRef": (GPS, 1), "GPSLatitude": (GPS, 2), "GPSLongitudeRef": (GPS, 3), "GPSLongitude": (GPS, 4),
    "GPSAltitudeRef": (GPS, 5), "GPSAltitude": (GPS, 6), "GPSStatus": (GPS, 9), "GPSHPositioningError": (GPS, 31),
}  # fmt: skip
NAMESPACES = {
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "drone": "http://www.autelrobotics.com/drone/1.0/",
    "drone-parrot": "http://www.parrot.com/drone-parrot/1.0/",
    "drone-skydio": "https://www.skydio.com/drone-skydio/1.0/",
    "Camera": "http://pix4d.com/camera/1.0",
    "GPano": "http://ns.google.com/photos/1.0/panorama/",
    "tiff": "http://ns.adobe.com/tiff/1.0/",
}
SIZE, XMP_TAG = (96, 72), 700


def packet(as_elements: bool = False, **texts: str) -> bytes:
    """XMP of properties by names such as drone_dji__GimbalYawDegree, as attributes or elements; "A__B__C" is C in a
    structure B."""
    attributes, elements = [], []
    structures: dict[str, list[str]] = {}
    for name, text in texts.items():
        prefix, *path = name.split("__")
        prefix = prefix.replace("_", "-")
        if len(path) == 2:
            structures.setdefault(f"{prefix}:{path[0]}", []).append(f"<{prefix}:{path[1]}>{text}</{prefix}:{path[1]}>")
        elif as_elements:
            elements.append(f"<{prefix}:{path[0]}>{text}</{prefix}:{path[0]}>")
        else:
            attributes.append(f'{prefix}:{path[0]}="{text}"')
    for name, parts in structures.items():
        elements.append(f'<{name} rdf:parseType="Resource">{"".join(parts)}</{name}>')
    spaces = " ".join(f'xmlns:{prefix}="{address}"' for prefix, address in NAMESPACES.items())
    return (
        '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {spaces} {" ".join(attributes)}>{"".join(elements)}</rdf:Description>'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


def degrees(angle: float) -> tuple[IFDRational, ...]:
    """Degrees, minutes and seconds as EXIF has them."""
    angle = abs(angle)
    minutes = (angle % 1.0) * 60.0
    seconds = Fraction((minutes % 1.0) * 60.0).limit_denominator(1_000_000)
    return IFDRational(int(angle), 1), IFDRational(int(minutes), 1), IFDRational(seconds.numerator, seconds.denominator)


def gps(latitude: float, longitude: float, altitude: float | None = None, **others: Any) -> dict[str, Any]:
    """Tags of a position."""
    tags = {
        "GPSLatitudeRef": "S" if latitude < 0.0 else "N",
        "GPSLatitude": degrees(latitude),
        "GPSLongitudeRef": "W" if longitude < 0.0 else "E",
        "GPSLongitude": degrees(longitude),
    }
    if altitude is not None:
        below = b"\x01" if altitude < 0.0 else b"\x00"
        tags |= {"GPSAltitude": IFDRational(round(1000 * abs(altitude)), 1000), "GPSAltitudeRef": below}
    return tags | others


def apple_note(x: float, y: float, z: float) -> bytes:
    """The maker note of an iPhone with its acceleration vector in g."""
    head = b"Apple iOS\0\0\1MM" + struct.pack(">HHHII", 1, 8, 10, 3, 32) + bytes(4)
    return head + b"".join(struct.pack(">ii", round(10_000 * axis), 10_000) for axis in (x, y, z))


def dji_note(yaw: float, pitch: float, roll: float) -> bytes:
    """The maker note of an early drone by DJI."""
    angles = {0x09: pitch, 0x0A: yaw, 0x0B: roll}
    entries = b"".join(struct.pack("<HHIf", tag, 11, 1, angle) for tag, angle in angles.items())
    return struct.pack("<H", len(angles)) + entries + bytes(4)


def picture(size: tuple[int, int] = SIZE, seed: int = 0) -> Image.Image:
    """Sharp noise of its own."""
    return Image.fromarray(np.random.default_rng(seed).integers(30, 220, (size[1], size[0], 3), dtype=np.uint8))


def write_photograph(
    path: Path, tags: Mapping[str, Any] | None = None, xmp: bytes = b"", size: tuple[int, int] = SIZE, seed: int = 0
) -> Path:
    """A photograph with tags of EXIF by their names and a packet of XMP."""
    exif = Image.Exif()
    for name, value in (tags or {}).items():
        directory, number = TAGS[name]
        if isinstance(value, tuple) and len(value) == 2:
            value = IFDRational(*value)  # noqa: PLW2901
        if directory is None:
            exif[number] = value
        else:
            exif.get_ifd(directory)[number] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    given: dict[str, Any] = {"xmp": xmp} if xmp else {}
    if tags:
        given["exif"] = exif
    if path.suffix.lower() == ".tif":
        picture(size, seed).save(path, tiffinfo={XMP_TAG: xmp} if xmp else {})
    else:
        picture(size, seed).save(path, quality=95, **given)
    return path
