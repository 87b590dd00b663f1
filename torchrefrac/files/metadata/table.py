"""What a user knows of photographs in a table: a CSV file with names of columns, or a geo.txt as of OpenDroneMap."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchrefrac.files.fields import MEGABYTE, MOST_MEGABYTES
from torchrefrac.files.metadata.attitude import Attitude, Mount
from torchrefrac.files.metadata.xmp import as_number
from torchrefrac.scene.capture import CaptureError

SIGMA_DEG = 0.5  # of gravity that a table states
ALIASES = {
    "name": ("name", "image", "filename", "file", "label"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "long"),
    "altitude": ("altitude", "alt", "z", "ellipsoidal_height"),
    "x": ("x", "east", "easting"),
    "y": ("y", "north", "northing"),
    "sigma_horizontal": ("sigma_horizontal", "sigma_h", "sigma_xy", "horizontal_accuracy"),
    "sigma_vertical": ("sigma_vertical", "sigma_v", "sigma_z", "vertical_accuracy"),
    "yaw": ("yaw",),
    "pitch": ("pitch",),
    "roll": ("roll",),
    "down_x": ("down_x",),
    "down_y": ("down_y",),
    "down_z": ("down_z",),
    "height": ("height",),
    "camera": ("camera",),
}
GROUPS = (("latitude", "longitude"), ("x", "y"), ("yaw", "pitch", "roll"), ("down_x", "down_y", "down_z"),
          ("sigma_horizontal", "sigma_vertical"))  # fmt: skip
"""Columns that go together."""
OF_GEO = ("altitude", "yaw", "pitch", "roll", "sigma_horizontal", "sigma_vertical")


@dataclass(frozen=True)
class Row:
    """What is stated of one photograph; None or empty: nothing. degrees: latitude and longitude; point: east and north
    in the table's reference system; sigma: horizontal and vertical; in m."""

    name: str
    degrees: tuple[float, float] | None = None
    point: tuple[float, float] | None = None
    altitude: float | None = None
    sigma: tuple[float, float] | None = None
    attitude: Attitude | None = None
    height: float | None = None
    camera: str = ""


@dataclass(frozen=True)
class Table:
    """Rows by the names of photographs, and the reference system of their points, where the table says it."""

    path: Path
    rows: Mapping[str, Row]
    crs: str | None = None

    def of(self, names: Sequence[str]) -> list[Row | None]:
        """The row of each photograph: its name with or without folders and ending, in any case. Raises CaptureError
        where the table names none of them."""
        by_name = {_bare(name): row for name, row in self.rows.items()}
        full = {name.lower(): row for name, row in self.rows.items()}
        found = [full.get(name.lower()) or by_name.get(_bare(name)) for name in names]
        if not any(found):
            first = next(iter(self.rows), "none")
            raise CaptureError(f"{self.path} names none of the photographs (it begins with {first}); is it theirs?")
        return found


def read_table(path: Path) -> Table:
    """Raises CaptureError, with the line, for whatever cannot be right."""
    if not path.is_file():
        raise CaptureError(f"{path} does not exist, but table must be a CSV file or a geo.txt")
    if path.stat().st_size > MOST_MEGABYTES * MEGABYTE:
        raise CaptureError(f"{path} has more than {MOST_MEGABYTES} MB; is it the right file?")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise CaptureError(f"{path} is no text in UTF-8; save it as CSV") from None
    numbered = [(number, line) for number, line in enumerate(lines, start=1) if line.strip() and line[0] != "#"]
    if not numbered:
        raise CaptureError(f"{path} is empty, but must have a row for each photograph")
    (_, first), *rest = numbered
    is_geo = first.strip().upper().startswith(("EPSG:", "WGS84", "+PROJ"))
    table = (_geo if is_geo else _csv)(path, first, rest)
    if len(table.rows) < len(rest):
        raise CaptureError(f"{path} has several rows with the same name; leave one of them")
    return table


def _csv(path: Path, first: str, rest: Sequence[tuple[int, str]]) -> Table:
    """Names of columns in the first line; the others with their numbers."""
    separator = max(",;\t", key=first.count)
    titles, *records = csv.reader([first, *(line for _, line in rest)], delimiter=separator)
    columns = [_column(path, title) for title in titles]
    if "name" not in columns:
        raise CaptureError(f"{path} has no column called name; its first line must name the columns")
    for group in GROUPS:
        present = [name for name in group if name in columns]
        if present and len(present) < len(group):
            raise CaptureError(
                f"{path} has the column {present[0]} without {_others(group, present)}; add what is missing"
            )
    numbers = [number for number, _ in rest]
    rows = [
        _row(path, number, columns, record, Mount.FORWARD) for number, record in zip(numbers, records, strict=False)
    ]
    return Table(path, {row.name: row for row in rows})


def _geo(path: Path, first: str, rest: Sequence[tuple[int, str]]) -> Table:
    """First the reference system, then "name x y z yaw pitch roll sigma sigma"; angles are those of an aircraft whose
    camera looks down."""
    crs = first.strip()
    in_degrees = crs.upper() in ("EPSG:4326", "WGS84") or "longlat" in crs.lower()
    columns = ("name", *(("longitude", "latitude") if in_degrees else ("x", "y")), *OF_GEO)
    rows = []
    for number, line in rest:
        record = line.split()
        if len(record) not in (3, 4, 7, 9):
            wanted = "a name, x, y, z and maybe yaw, pitch, roll and two sigmas"
            raise CaptureError(f"{path}: line {number} has {len(record)} columns, but must have {wanted}")
        rows.append(_row(path, number, columns[: len(record)], record, Mount.DOWN))
    return Table(path, {row.name: row for row in rows}, None if in_degrees else crs)


def _column(path: Path, title: str) -> str:
    """The name of a column, whatever the table calls it."""
    plain = title.strip().lower().split("[")[0].strip().replace(" ", "_")
    for name, aliases in ALIASES.items():
        if plain in aliases:
            return name
    raise CaptureError(f"{path}: {title.strip()!r} is no column that is known here: {', '.join(ALIASES)}")


def _others(group: Sequence[str], present: Sequence[str]) -> str:
    return " and ".join(name for name in group if name not in present)


def _row(path: Path, number: int, columns: Sequence[str], record: Sequence[str], mount: Mount) -> Row:
    texts = {name: text.strip() for name, text in zip(columns, record, strict=False)}
    values: dict[str, float] = {}
    for name, text in texts.items():
        if text and name not in ("name", "camera"):
            value = as_number(text)
            if value is None:
                raise CaptureError(f"{path}: line {number}: {name} is {text[:40]!r}, but must be a number")
            values[name] = value
    if not texts.get("name"):
        raise CaptureError(f"{path}: line {number} has no name; give that of a photograph")

    def together(*names: str) -> tuple[float, ...] | None:
        return tuple(values[name] for name in names) if all(name in values for name in names) else None

    degrees, point, sigma = (together(*group) for group in (GROUPS[0], GROUPS[1], GROUPS[4]))
    where = f"{path}: line {number}"
    if degrees is not None and not (abs(degrees[0]) <= 90.0 and abs(degrees[1]) <= 360.0):
        raise CaptureError(f"{where}: {degrees[0]:g}, {degrees[1]:g} is no latitude and longitude in degrees")
    if sigma is not None and min(sigma) <= 0.0:
        raise CaptureError(f"{where}: a sigma is {min(sigma):g}, but must be above 0")
    if values.get("height", 1.0) <= 0.0:
        raise CaptureError(f"{where}: height is {values['height']:g}, but a camera stands above the water: above 0")
    return Row(
        name=texts["name"],
        degrees=_pair(degrees),
        point=_pair(point),
        altitude=values.get("altitude"),
        sigma=_pair(sigma),
        attitude=_attitude(where, together(*GROUPS[2]), together(*GROUPS[3]), mount),
        height=values.get("height"),
        camera=texts.get("camera", ""),
    )


def _pair(values: tuple[float, ...] | None) -> tuple[float, float] | None:
    return None if values is None else (values[0], values[1])


def _attitude(
    where: str, angles: tuple[float, ...] | None, down: tuple[float, ...] | None, mount: Mount
) -> Attitude | None:
    turned = None
    if angles is not None:
        yaw, pitch, roll = angles
        turned = Attitude.of_angles(yaw, pitch, roll, SIGMA_DEG, "table", mount)
    if down is None:
        return turned
    size = math.hypot(*down)
    if size == 0.0:
        raise CaptureError(f"{where}: down is 0, 0, 0, which has no direction")
    x, y, z = (part / size for part in down)
    return Attitude((x, y, z), turned and turned.heading_deg, SIGMA_DEG, "table")


def _bare(name: str) -> str:
    """Without folders and ending."""
    return Path(name.replace("\\", "/")).stem.lower()
