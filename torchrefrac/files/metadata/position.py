"""Where a photograph was taken, as its file says: latitude, longitude and altitudes, each in its own datum."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from torchrefrac.files.metadata.exif import Exif
from torchrefrac.files.metadata.xmp import Xmp

HORIZONTAL_SIGMA, VERTICAL_SIGMA = 1.5, 3.0  # m; of a receiver of its own, without corrections
OPTIMISM = 1.5  # by how much drones' own standard deviations of RTK are too small
LEAST_SIGMA = 0.01  # m
FIXED, FLOAT = 50, 34  # RtkFlag of DJI; 16: a receiver of its own, 0: none
POSITIONING_ERROR = "GPS Tag 0x001F"  # GPSHPositioningError of phones, whose name ExifRead does not know
SPACE = 1e5  # m
NO_PLACE = 1e-6  # degrees; a receiver without a fix says 0, 0
APART = 0.01  # degrees that two tags of one photograph may be apart
MAKERS = ("drone-dji", "drone", "drone-autel", "drone-skydio", "drone-parrot")  # prefixes of XMP
TELLING = ("GpsLatitude", "Latitude", "AbsoluteAltitude", "RelativeAltitude", "RtkFlag")


class Vertical(StrEnum):
    """What an altitude is counted from."""

    ELLIPSOID = "ellipsoid"
    SEA_LEVEL = "sea level"
    TAKE_OFF = "take-off"
    TABLE = "table"


@dataclass(frozen=True)
class Fix:
    """Degrees; altitudes in m by what they are counted from; sigma in m, horizontal and vertical. is_precise: by RTK.
    source: what said so."""

    latitude: float
    longitude: float
    altitudes: Mapping[Vertical, float]
    sigma: tuple[float, float]
    source: str
    is_precise: bool = False


def fix_of(exif: Exif, xmp: Xmp) -> Fix | None:
    """XMP has more digits than EXIF; where the two are at different places EXIF is right, for programs that geotag
    write it alone. None where neither has a position: 0, 0 is none."""
    maker = next((name for name in MAKERS if any(xmp.number(f"{name}:{tag}") is not None for tag in TELLING)), "")
    plain, precise = _place_of_exif(exif), _place_of_xmp(xmp, maker)
    if plain is None and precise is None:
        return None
    is_moved = plain is not None and precise is not None and math.dist(plain, precise) > APART
    latitude, longitude = plain if plain is not None and (precise is None or is_moved) else precise or (0.0, 0.0)
    sigma, is_precise = _sigma(exif, xmp, maker)
    altitudes = _altitudes_of_xmp(xmp, maker, is_precise)
    absolute = [datum for datum in altitudes if datum is not Vertical.TAKE_OFF]
    if is_moved or not absolute:  # EXIF repeats the altitude of XMP, whatever that is counted from
        altitudes = {datum: altitudes[datum] for datum in altitudes if datum not in absolute} | _altitude_of_exif(exif)
    source = "EXIF GPS" if precise is None or is_moved else f"XMP {maker}"
    return Fix(latitude, longitude, altitudes, sigma, f"{source}, RTK" if is_precise else source, is_precise)


def _place_of_exif(exif: Exif) -> tuple[float, float] | None:
    """Latitude and longitude."""
    if exif.text("GPS GPSStatus") == "V":  # the measurement is void
        return None
    return believed_place(_degrees(exif, "GPS GPSLatitude", "S"), _degrees(exif, "GPS GPSLongitude", "W"))


def _place_of_xmp(xmp: Xmp, maker: str) -> tuple[float, float] | None:
    latitude = xmp.number(f"{maker}:GpsLatitude", f"{maker}:Latitude")
    return believed_place(
        latitude, xmp.number(*(f"{maker}:{name}" for name in ("GpsLongitude", "GpsLongtitude", "Longitude")))
    )


def believed_place(latitude: float | None, longitude: float | None) -> tuple[float, float] | None:
    """Latitude and longitude in degrees; None where one is missing or cannot be, and of 0, 0, which is no fix."""
    if latitude is None or longitude is None or not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return None
    return (latitude, longitude) if max(abs(latitude), abs(longitude)) > NO_PLACE else None


def _altitude_of_exif(exif: Exif) -> dict[Vertical, float]:
    altitude, below = exif.number("GPS GPSAltitude"), exif.number("GPS GPSAltitudeRef") in (1.0, 3.0)
    return believed_altitudes({Vertical.SEA_LEVEL: -altitude if altitude and below else altitude})


def _altitudes_of_xmp(xmp: Xmp, maker: str, is_precise: bool) -> dict[Vertical, float]:
    """With RTK, and from Skydio, altitudes are above the ellipsoid; without, of whatever kind, near sea level."""
    absolute, relative = (xmp.number(f"{maker}:{name}Altitude") for name in ("Absolute", "Relative"))
    ellipsoid = is_precise or maker == "drone-skydio" or xmp.text(f"{maker}:AltitudeType") == "RtkAlt"
    return believed_altitudes(
        {Vertical.ELLIPSOID if ellipsoid else Vertical.SEA_LEVEL: absolute, Vertical.TAKE_OFF: relative}
    )


def believed_altitudes(altitudes: Mapping[Vertical, float | None]) -> dict[Vertical, float]:
    """Those that are there, of places where cameras are."""
    return {level: altitude for level, altitude in altitudes.items() if altitude is not None and abs(altitude) < SPACE}


def _sigma(exif: Exif, xmp: Xmp, maker: str) -> tuple[tuple[float, float], bool]:
    """Horizontal and vertical, in m, and whether they are those of RTK."""
    flag = xmp.number(f"{maker}:RtkFlag")
    tags = [xmp.number(f"{maker}:RtkStd{axis}") for axis in ("Lon", "Lat", "Hgt")]
    if flag in (FIXED, FLOAT) and None not in tags:
        east, north, up = (OPTIMISM * max(tag or 0.0, LEAST_SIGMA) for tag in tags)
        return (max(east, north), up), True
    horizontal = xmp.number(f"{maker}:GpsHorizontalAccuracy", "Camera:GPSXYAccuracy")
    vertical = xmp.number(f"{maker}:GpsVerticalAccuracy", "Camera:GPSZAccuracy")
    horizontal = horizontal or exif.number(POSITIONING_ERROR)
    if not horizontal or horizontal < 0.0:
        return (HORIZONTAL_SIGMA, VERTICAL_SIGMA), False
    vertical = vertical if vertical and vertical > 0.0 else VERTICAL_SIGMA / HORIZONTAL_SIGMA * horizontal
    return (max(horizontal, LEAST_SIGMA), max(vertical, LEAST_SIGMA)), False


def _degrees(exif: Exif, name: str, negative: str) -> float | None:
    """From degrees, minutes and seconds and the letter of the hemisphere."""
    parts = exif.numbers(name)
    if len(parts) != 3:
        return None
    angle = parts[0] + parts[1] / 60.0 + parts[2] / 3600.0
    return -angle if exif.text(f"{name}Ref").upper().startswith(negative) else angle
