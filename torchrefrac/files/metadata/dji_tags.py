"""Tags as a drone by DJI with RTK writes them, into photographs that are made."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from torchrefrac.atomic import replacing
from torchrefrac.camera import Intrinsics
from torchrefrac.files.metadata.position import FIXED

MAKE, MODEL, SENSOR_MM = "DJI", "FC6310R", 13.2  # a Phantom 4 RTK
MAKE_TAG, MODEL_TAG, CAMERA_TAGS, GPS_TAGS = 0x010F, 0x0110, 0x8769, 0x8825
TAKEN, FOCAL_MM, EQUIVALENT, SERIAL = 0x9003, 0x920A, 0xA405, 0xA431
DEWARPED = 5  # coefficients of distortion
PACKET = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
{properties}/>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""


@dataclass(frozen=True)
class DroneTags:
    """What a drone says of one photograph. Degrees; m, altitude above the ellipsoid; sigma: horizontal and vertical.
    camera: which of several it is from. time: as EXIF has it."""

    latitude: float
    longitude: float
    altitude: float
    above_take_off: float
    sigma: tuple[float, float]
    yaw: float
    pitch: float
    roll: float
    camera: int
    intrinsics: Intrinsics
    time: str


def write_with_tags(image: UInt8[np.ndarray, "height width 3"], tags: DroneTags, path: Path) -> None:
    """Write RGB as PNG, with EXIF and XMP."""
    from PIL import Image, PngImagePlugin  # noqa: PLC0415 - slow to import

    exif = Image.Exif()
    exif[MAKE_TAG], exif[MODEL_TAG] = MAKE, MODEL
    share = float(tags.intrinsics.focal[0]) / tags.intrinsics.width
    camera = {TAKEN: tags.time, FOCAL_MM: _rational(share * SENSOR_MM), EQUIVALENT: round(share * 36.0)}
    camera[SERIAL] = f"CAMERA{tags.camera}"
    north, east = (_sexagesimal(angle) for angle in (tags.latitude, tags.longitude))
    references = "S" if tags.latitude < 0.0 else "N", "W" if tags.longitude < 0.0 else "E"
    place = {1: references[0], 2: north, 3: references[1], 4: east, 5: b"\0", 6: _rational(abs(tags.altitude))}
    exif.get_ifd(CAMERA_TAGS).update(camera)
    exif.get_ifd(GPS_TAGS).update(place)
    text = PngImagePlugin.PngInfo()
    text.add_itxt("XML:com.adobe.xmp", _packet(tags))
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, exif=exif, pnginfo=text)


def _packet(tags: DroneTags) -> str:
    named = {
        "GpsLatitude": f"{tags.latitude:+.9f}",
        "GpsLongitude": f"{tags.longitude:+.9f}",
        "AbsoluteAltitude": f"{tags.altitude:+.4f}",
        "RelativeAltitude": f"{tags.above_take_off:+.2f}",
        "GimbalYawDegree": f"{tags.yaw:+.2f}",
        "GimbalPitchDegree": f"{tags.pitch:+.2f}",
        "GimbalRollDegree": f"{tags.roll:+.2f}",
        "RtkFlag": f"{FIXED}",
        "RtkStdLon": f"{tags.sigma[0]:.5f}",
        "RtkStdLat": f"{tags.sigma[0]:.5f}",
        "RtkStdHgt": f"{tags.sigma[1]:.5f}",
        **_calibration(tags.intrinsics),
    }
    return PACKET.format(properties="\n".join(f'   drone-dji:{name}="{value}"' for name, value in named.items()))


def _calibration(intrinsics: Intrinsics) -> dict[str, str]:
    """Of a lens with as many coefficients as there is a place for."""
    if intrinsics.fisheye is not None or intrinsics.distortion.shape[-1] != DEWARPED:
        return {}
    (cx, cy), (fx, fy) = intrinsics.principal_point.tolist(), intrinsics.focal.tolist()
    middle = (cx - 0.5 * intrinsics.width, cy - 0.5 * intrinsics.height)
    numbers = (fx, fy, *middle, *intrinsics.distortion.tolist())
    return {"DewarpFlag": "0", "DewarpData": "2024-05-17;" + ",".join(f"{number:.9f}" for number in numbers)}


def _sexagesimal(angle: float) -> tuple[Any, ...]:
    """Degrees, minutes and seconds as fractions."""
    minutes = abs(angle) % 1.0 * 60.0
    return _rational(int(abs(angle))), _rational(int(minutes)), _rational(minutes % 1.0 * 60.0)


def _rational(number: float) -> Any:
    from PIL.TiffImagePlugin import IFDRational  # noqa: PLC0415

    return IFDRational(*Fraction(number).limit_denominator(1_000_000).as_integer_ratio())
