"""What kinds of pictures lie on a memory card, and which of them are no photographs for a reconstruction."""

import re
from collections.abc import Sequence
from enum import Enum
from pathlib import Path

from torchrefrac.files.metadata.xmp import Xmp

PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".gpr", ".iiq", ".3fr")
HEIC = (".heic", ".heif", ".hif", ".avif")
FILMS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mts", ".webm", ".lrv")
THERMAL_NAME = re.compile(r"_(T|THRM|IR)$", re.IGNORECASE)
ZOOM_NAME = re.compile(r"_(Z|ZOOM)$", re.IGNORECASE)
BAND_NAME = re.compile(r"_MS_(G|R|RE|NIR)$", re.IGNORECASE)
BANDS = ("BLUE", "GREEN", "RED", "REDEDGE", "RED EDGE", "NIR")
PANORAMA_ASPECT = 2.4  # no single photograph is wider
SPHERE_WIDTH = 4096  # of what is exactly twice as wide as high


class Kind(Enum):
    """The value is the reason for which a picture is left out; of what is not, it is empty."""

    ORDINARY = ""
    ZOOM = "taken with the zoom camera beside wider ones; import it alone, from a folder of its own"
    BAND = "one band of a multispectral camera beside photographs in colour"
    THERMAL = "a thermal picture, whose camera sees something else than the others"
    PANORAMA = "a panorama, which has no single place from where it was taken"


def kind_of(path: Path, width: int, height: int, xmp: Xmp) -> Kind:
    """By what the file says, else by its name or its sides."""
    source = xmp.text("drone-dji:ImageSource", "drone:ImageSource").lower()
    long, short = max(width, height), max(min(width, height), 1)
    if any(xmp.text(f"GPano:{name}") for name in ("ProjectionType", "FullPanoWidthPixels")):
        return Kind.PANORAMA
    if long >= PANORAMA_ASPECT * short or (long == 2 * short and long >= SPHERE_WIDTH):
        return Kind.PANORAMA
    if "infrared" in source or "thermal" in source or (not source and THERMAL_NAME.search(path.stem)):
        return Kind.THERMAL
    if BAND_NAME.search(path.stem) or xmp.text("drone-dji:BandName", "Camera:BandName").upper() in BANDS:
        return Kind.BAND
    if "zoom" in source or (not source and ZOOM_NAME.search(path.stem)):
        return Kind.ZOOM
    return Kind.ORDINARY


def left_out_by_kind(kinds: Sequence[Kind]) -> list[str]:
    """Of each picture why it is left out; empty: it is not. What is the only kind there is stays, but for panoramas."""
    first = next((kind for kind in (Kind.ORDINARY, Kind.ZOOM, Kind.BAND, Kind.THERMAL) if kind in kinds), None)
    return ["" if kind is first else kind.value for kind in kinds]


def unreadable(path: Path, stems: set[str]) -> str:
    """Why a file that no image library here reads is left out, and what makes a picture of it; empty where it is none.

    stems: lower-case names of the pictures, without ending.
    """
    ending, has_twin = path.suffix.lower(), str(path.with_suffix("")).lower() in stems
    if ending in RAW:
        remedy = "its picture is taken" if has_twin else "convert it to TIFF with dcraw, darktable or RawTherapee"
        return f"raw data of a sensor; {remedy}"
    if ending in HEIC:
        remedy = "its picture is taken" if has_twin else "convert it to JPEG with heif-convert, or sips on a Mac"
        return f"HEIC; {remedy}"
    return ""
