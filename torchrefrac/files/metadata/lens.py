"""Focal length, principal point and distortion of a photograph, as far as its file says them."""

import math
from dataclasses import dataclass, replace
from typing import Any

from torchrefrac.camera import Intrinsics
from torchrefrac.files.intrinsics import NUMBERS
from torchrefrac.files.metadata.exif import Exif
from torchrefrac.files.metadata.sensors import sensor_width
from torchrefrac.files.metadata.xmp import Xmp
from torchrefrac.files.plausible import implausible

CALIBRATED_SIGMA, EXIF_SIGMA, FILM_SIGMA, GUESSED_SIGMA = 0.01, 0.05, 0.1, 0.3
"""Of a focal length, relative: calibrated at the factory, by EXIF (rounded, and of another distance), of a film by its
subtitles, guessed."""
CENTER_SIGMA, CALIBRATED_CENTER_SIGMA = 0.01, 0.002
"""Of a principal point, in units of the longer side: assumed in the middle, calibrated."""
DISTORTION_SIGMA, CALIBRATED_DISTORTION_SIGMA = 0.05, 0.01
"""Of each coefficient: assumed to be none, calibrated."""
GUESS = 1.2  # focal length in units of the longer side: 45 degrees of view
OFF_CENTER = 0.05  # of the size, by which a principal point may be off the middle
FOCAL_RANGE = 0.2, 30.0  # of focal lengths in units of the longer side that are believed
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # FocalPlaneResolutionUnit
LEAST_EQUIVALENT = 15.0  # mm; what is shorter is not an equivalent, but the lens's own
FILM_DIAGONAL = math.hypot(36.0, 24.0)
WIDER_THAN_A_SENSOR = 1.6  # sides of a photograph that is cropped, above and below, from a sensor of 4:3
DIAGONAL_OF_A_SENSOR = 1.25  # in units of its width
DIGITS = 9  # of what is written
NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Lens:
    """Pixels, counted from the corner of the image; distortion as in OpenCV. sigma: of the focal length, relative;
    center_sigma, px, and distortion_sigma, of each coefficient: None where nobody knows. source, center_source,
    distortion_source: what said so; empty: assumed. model: of the distortion, "opencv" (0, 4, 5 or 8 coefficients) or
    "fisheye" (4)."""

    focal: tuple[float, float]
    principal_point: tuple[float, float]
    distortion: tuple[float, ...]
    sigma: float
    source: str
    center_source: str = ""
    distortion_source: str = ""
    model: str = "opencv"
    center_sigma: float | None = None
    distortion_sigma: float | None = None

    @property
    def is_guessed(self) -> bool:
        return self.sigma >= GUESSED_SIGMA

    def content(self, size: tuple[int, int]) -> dict[str, Any]:
        """As JSON has it, for images of some size."""
        numbers = (*size, *(round(number, DIGITS) for number in (*self.focal, *self.principal_point)))
        sigma = {"focal": self.sigma, "principal_point": self.center_sigma, "distortion": self.distortion_sigma}
        return {
            "model": self.model,
            **dict(zip(NUMBERS, numbers, strict=True)),
            "distortion": [round(number, DIGITS) for number in self.distortion],
            "sigma": {name: number for name, number in sigma.items() if number is not None},
        }


def lens_of(exif: Exif, xmp: Xmp, width: int, height: int) -> Lens:
    """The best that the file says; a guess where it says nothing that can be."""
    for found in (_dewarp(xmp, width, height), _calibrated(xmp, width, height), _by_exif(exif, width, height)):
        if found is not None and _is_believed(found, width, height):
            return found
    return centered(GUESS * max(width, height), width, height, GUESSED_SIGMA, "guessed")


def believed_equivalent(equivalent: float, width: int, height: int, source: str) -> Lens | None:
    """From the 35 mm equivalent of a film in mm; None where it cannot be one. Films are often cut from the middle of a
    sensor, by a share that nobody states."""
    lens = _by_equivalent(equivalent, width, height, FILM_SIGMA, source)
    return lens if equivalent >= LEAST_EQUIVALENT and _is_believed(lens, width, height) else None


def centered(focal: float, width: int, height: int, sigma: float, source: str) -> Lens:
    """Without distortion, its principal point in the middle; neither is certain."""
    return Lens(
        focal=(focal, focal),
        principal_point=(0.5 * width, 0.5 * height),
        distortion=NO_DISTORTION,
        sigma=sigma,
        source=source,
        center_sigma=CENTER_SIGMA * max(width, height),
        distortion_sigma=DISTORTION_SIGMA,
    )


def _dewarp(xmp: Xmp, width: int, height: int) -> Lens | None:
    """DJI's calibration: "date;fx,fy,cx,cy,k1,k2,p1,p2,k3", cx and cy from the middle. Where the flag says that the
    photograph has been straightened, there is no distortion left in it."""
    _, _, listed = xmp.text("drone-dji:DewarpData").rpartition(";")
    try:
        numbers = [float(number) for number in listed.split(",")]
    except ValueError:
        return None
    if len(numbers) != 9:
        return None
    fx, fy, cx, cy, *distortion = numbers
    source = "XMP drone-dji:DewarpData"
    is_straight = xmp.number("drone-dji:DewarpFlag") == 1.0
    return Lens(
        focal=(fx, fy),
        principal_point=(0.5 * width + cx, 0.5 * height + cy),
        distortion=NO_DISTORTION if is_straight else tuple(distortion),
        sigma=CALIBRATED_SIGMA,
        source=source,
        center_source=source,
        distortion_source="XMP drone-dji:DewarpFlag, straightened" if is_straight else source,
        center_sigma=CALIBRATED_CENTER_SIGMA * max(width, height),
        distortion_sigma=CALIBRATED_DISTORTION_SIGMA,
    )


def _calibrated(xmp: Xmp, width: int, height: int) -> Lens | None:
    """Focal length and principal point in pixels, of DJI, Autel or Skydio."""
    for maker in ("drone-dji", "drone", "drone-autel"):
        names = (f"{maker}:Calibrated{name}" for name in ("FocalLength", "OpticalCenterX", "OpticalCenterY"))
        focal, cx, cy = (xmp.number(name) for name in names)
        if focal is not None:
            return _from_tags((focal, focal), cx, cy, (width, height), f"XMP {maker}:CalibratedFocalLength")
    skydio = [
        xmp.number(f"drone-skydio:Calibrated{name}/{axis}")
        for name in ("FocalLength", "OpticalCenter")
        for axis in "XY"
    ]
    fx, fy, cx, cy = skydio
    if fx is None or fy is None:
        return None
    return _from_tags((fx, fy), cx, cy, (width, height), "XMP drone-skydio:CalibratedFocalLength")


def _from_tags(
    focal: tuple[float, float], cx: float | None, cy: float | None, size: tuple[int, int], source: str
) -> Lens:
    lens = replace(centered(focal[0], *size, CALIBRATED_SIGMA, source), focal=focal)
    if cx is None or cy is None:
        return lens
    return replace(
        lens, principal_point=(cx, cy), center_source=source, center_sigma=CALIBRATED_CENTER_SIGMA * max(size)
    )


def _by_exif(exif: Exif, width: int, height: int) -> Lens | None:
    focal, wide = exif.number("EXIF FocalLength"), max(width, height)
    zoom = max(exif.number("EXIF DigitalZoomRatio") or 1.0, 1.0)
    mm, source = _sensor_width(exif, wide)
    if focal and mm:
        return centered(zoom * focal / mm * wide, width, height, EXIF_SIGMA, source)
    equivalent = exif.number("EXIF FocalLengthIn35mmFilm")
    if not equivalent:
        return None
    return _by_equivalent(equivalent, width, height, EXIF_SIGMA, "EXIF 35 mm equivalent")


def _by_equivalent(equivalent: float, width: int, height: int, sigma: float, source: str) -> Lens:
    return centered(focal_of_equivalent(equivalent, width, height), width, height, sigma, source)


def focal_of_equivalent(equivalent: float, width: int, height: int) -> float:
    """The focal length in pixels that is `equivalent` mm on 35 mm film: of the diagonal; for 16:9 of that of the whole
    sensor."""
    wide = max(width, height)
    cropped = wide >= WIDER_THAN_A_SENSOR * min(width, height)
    diagonal = DIAGONAL_OF_A_SENSOR * wide if cropped else math.hypot(width, height)
    return equivalent / FILM_DIAGONAL * diagonal


def _sensor_width(exif: Exif, wide: int) -> tuple[float | None, str]:
    """In mm along the longer side, and where it is from: a table of models, or the resolution of the sensor, which is
    that of the photograph as taken, whatever its size is now."""
    known = sensor_width(exif.text("Image Model"))
    if known is not None:
        return known, "EXIF focal length, sensor by model"
    resolution = exif.number("EXIF FocalPlaneXResolution")
    unit = MM_PER_UNIT.get(int(exif.number("EXIF FocalPlaneResolutionUnit") or 2))
    taken = max(exif.number("EXIF ExifImageWidth") or wide, exif.number("EXIF ExifImageLength") or 0.0)
    if not resolution or unit is None:
        return None, ""
    return taken / resolution * unit, "EXIF focal length and resolution"


def _is_believed(lens: Lens, width: int, height: int) -> bool:
    """Tags of photographs of another size, or in other units, are not."""
    low, high = (share * max(width, height) for share in FOCAL_RANGE)
    middle = zip(lens.principal_point, (width, height), strict=True)
    if not all(low <= focal <= high for focal in lens.focal):
        return False
    if not all(abs(center - 0.5 * size) <= OFF_CENTER * size for center, size in middle):
        return False
    return implausible(Intrinsics.create(width, height, lens.focal, lens.principal_point, lens.distortion)) is None
