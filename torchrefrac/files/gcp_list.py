"""`gcp_list.txt` of OpenDroneMap: the reference system, then "x y z pixel_x pixel_y image [name]" of every click."""

import re
from pathlib import Path

from torchrefrac.files.control_points import Stated, is_check, known_position, numbers_of, text_lines
from torchrefrac.scene.capture import CaptureError
from torchrefrac.scene.survey import ControlPoint

WHAT = "a list of ground control points (OpenDroneMap): the reference system, then x y z pixel_x pixel_y image [name]"
COLUMNS = ("x", "y", "z", "pixel_x", "pixel_y")
UTM = re.compile(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)


def read_gcp_list(path: Path) -> Stated:
    """Points are those of one name, or without names of one position; pixels count from the corner. Raises
    CaptureError, with the line, for whatever cannot be right."""
    (_, first), *rest = [(number, line) for number, line in text_lines(path, WHAT) if not line.startswith("#")]
    crs = _crs(path, first)
    positions: dict[str, list[float]] = {}
    pixels: dict[str, dict[str, list[float]]] = {}
    for number, line in rest:
        where, words = f"{path}: line {number}", line.split()
        if len(words) < len(COLUMNS) + 1:
            raise CaptureError(f"{where} has {len(words)} columns, but must have {', '.join(COLUMNS)} and an image")
        *position, u, v = numbers_of(words[:5], COLUMNS, where)
        image, name = words[5], words[6] if len(words) > 6 else " ".join(words[:3])
        if positions.setdefault(name, position) != position:
            raise CaptureError(
                f"{where}: {name} has another position than in a line before; give them names that differ"
            )
        if image in pixels.setdefault(name, {}):
            raise CaptureError(f"{where}: {name} is clicked twice in {image}; leave one of them")
        pixels[name][image] = [u, v]
    points = {
        name: ControlPoint(pixels[name], known_position(position), is_check=is_check(name))
        for name, position in positions.items()
    }
    return Stated(points, crs=crs)


def _crs(path: Path, first: str) -> str:
    """What the first line says, as pyproj takes it."""
    zone = UTM.fullmatch(first)
    if zone is not None:
        return f"EPSG:{326 if zone[2].upper() == 'N' else 327}{int(zone[1]):02d}"
    if first.upper() == "WGS84":
        return "EPSG:4326"
    if not first.lower().startswith(("epsg:", "+proj")):
        raise CaptureError(f"{path} begins with {first[:40]!r}, but must with a reference system such as EPSG:32633")
    return first
