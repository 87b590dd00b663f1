"""Ground control as tables: a CSV file of points (name, x, y, z), and beside it one of clicks (image, name, px, py)."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrefrac.files.control_points import (
    SIGMA,
    Stated,
    is_check,
    known_position,
    numbers_of,
    text_lines,
)
from torchrefrac.scene.capture import CaptureError
from torchrefrac.scene.survey import ControlPoint

CLICKS = "clicks.csv"
"""The name of the second table, by itself or behind that of the first and an underscore."""
POINT = {
    "name": ("name", "label", "id", "point"),
    "x": ("x", "east", "easting", "longitude", "lon"),
    "y": ("y", "north", "northing", "latitude", "lat"),
    "z": ("z", "height", "altitude", "elevation", "h"),
    "sigma": ("sigma", "accuracy"),
    "sigma_xy": ("sigma_xy", "sigma_h", "sigma_horizontal", "horizontal_accuracy"),
    "sigma_z": ("sigma_z", "sigma_v", "sigma_vertical", "vertical_accuracy"),
    "check": ("check", "is_check", "checkpoint"),
}
CLICK = {
    "image": ("image", "photo", "filename", "file"),
    "name": ("name", "label", "id", "point"),
    "px": ("px", "u", "pixel_x", "x"),
    "py": ("py", "v", "pixel_y", "y"),
}
YES, NO = ("1", "true", "yes", "check"), ("", "0", "false", "no", "control")
Row = tuple[str, dict[str, str]]


def read_control_table(path: Path) -> Stated:
    """A first line that is a reference system, or `# EPSG:32633`, says which one; pixels count from the corner. Raises
    CaptureError, with the line, for whatever cannot be right."""
    lines = text_lines(path, "a CSV file of ground control points, with the columns name, x, y and z")
    first = lines[0][1].lstrip("# ")
    crs = first if first.lower().startswith(("epsg:", "+proj")) else None
    rows = _rows(path, lines[0 if crs is None else 1 :], POINT, ("name", "x", "y", "z"))
    pixels = _clicks(path)
    points: dict[str, ControlPoint] = {}
    for where, row in rows:
        name = row["name"]
        if not name or name in points:
            raise CaptureError(f"{where} has {f'the name {name!r} of a line before' if name else 'no name'}")
        position = numbers_of([row[axis] for axis in "xyz"], "xyz", where)
        check = is_check(name) or _flag(row.get("check", ""), where)
        points[name] = ControlPoint(pixels.pop(name, {}), known_position(position, _sigma(row, where)), is_check=check)
    if pixels:
        raise CaptureError(f"{_beside(path)} has clicks of {next(iter(pixels))}, which is no point of {path}")
    return Stated(points, crs=crs)


def _beside(path: Path) -> Path:
    own = path.with_name(f"{path.stem}_{CLICKS}")
    return own if own.is_file() else path.with_name(CLICKS)


def _clicks(path: Path) -> dict[str, dict[str, list[float]]]:
    """Pixels by point and image."""
    beside, pixels = _beside(path), {}
    what = f"a CSV file of where the points of {path.name} are in the images: image, name, px, py"
    for where, row in _rows(beside, text_lines(beside, what), CLICK, tuple(CLICK)):
        of = pixels.setdefault(row["name"], {})
        if row["image"] in of:
            raise CaptureError(f"{where}: {row['name']} is clicked twice in {row['image']}; leave one of them")
        of[row["image"]] = numbers_of((row["px"], row["py"]), ("px", "py"), where)
    return pixels


def _rows(
    path: Path, lines: Sequence[tuple[int, str]], columns: Mapping[str, Sequence[str]], needed: Sequence[str]
) -> list[Row]:
    """Where each stands, and its texts by the names of columns."""
    (_, first), *rest = [(number, line) for number, line in lines if not line.startswith("#")] or [(0, "")]
    separator = max(",;\t", key=first.count)
    titles = [title.strip().lower() for title in next(csv.reader([first], delimiter=separator), [])]
    names = [next((name for name, also in columns.items() if title in also), title) for title in titles]
    missing = [name for name in needed if name not in names]
    if missing:
        raise CaptureError(f"{path} has no column {missing[0]}; its first line must name {', '.join(needed)}")
    found = []
    for number, line in rest:
        where, texts = f"{path}: line {number}", next(csv.reader([line], delimiter=separator))
        if len(texts) != len(names):
            raise CaptureError(f"{where} has {len(texts)} columns, but the first line names {len(names)}")
        found.append((where, {name: text.strip() for name, text in zip(names, texts, strict=True)}))
    return found


def _sigma(row: Mapping[str, str], where: str) -> tuple[float, float]:
    """Horizontal and vertical."""
    both = row.get("sigma", "")
    texts = [row.get("sigma_xy", "") or both, row.get("sigma_z", "") or both]
    given = [text or str(usual) for text, usual in zip(texts, SIGMA, strict=True)]
    horizontal, vertical = numbers_of(given, ("sigma_xy", "sigma_z"), where)
    if min(horizontal, vertical) <= 0.0:
        raise CaptureError(f"{where}: a sigma is {min(horizontal, vertical):g}, but must be above 0")
    return horizontal, vertical


def _flag(text: str, where: str) -> bool:
    if text.lower() not in (*YES, *NO):
        raise CaptureError(f"{where}: check is {text[:40]!r}, but must be yes or no")
    return text.lower() in YES
