"""Tables of cameras: names, positions and, where they are known, omega, phi and kappa or yaw, pitch and roll.

With names of columns in the first line (CSV), or without: then name, x, y, z, and perhaps omega, phi and kappa, as
Metashape and Pix4D write them. Angles are in degrees. Yaw, pitch and roll are those of an aircraft whose camera looks
down, the top of its image forward, as Metashape has them. Further columns are passed over.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.files.fields import FARTHEST, MEGABYTE, MOST_MEGABYTES
from torchrefrac.files.metadata.attitude import Mount, cam_from_world
from torchrefrac.geometry.photogrammetric import rotation_of_angles
from torchrefrac.scene import SceneError, Viewpoints

POSITION, OPK, YPR = ("x", "y", "z"), ("omega", "phi", "kappa"), ("yaw", "pitch", "roll")
ALIASES = {
    "name": ("name", "image", "imagename", "image_name", "label", "photoid", "filename", "file"),
    "x": ("x", "east", "easting"), "y": ("y", "north", "northing"), "z": ("z", "altitude", "height"),
    **{name: (name,) for name in (*OPK, *YPR)},
}  # fmt: skip
WITHOUT_HEAD = ("name", *POSITION, *OPK)


def read_table(path: Path) -> Viewpoints:
    """Raises SceneError, with the line, for whatever cannot be right."""
    columns, records = _records(path)
    lacking = [name for name in ("name", *POSITION) if name not in columns]
    if lacking:
        raise SceneError(f"{path} has no column called {lacking[0]}; cameras need a name, x, y and z")
    angles = next((group for group in (OPK, YPR) if all(name in columns for name in group)), ())
    names: dict[str, None] = {}
    rows: list[list[float]] = []
    for number, record in records:
        where = f"{path}: line {number}"
        name = record[columns["name"]].strip() if len(record) > columns["name"] else ""
        if not name or name in names:
            raise SceneError(f"{where} has {f'the name {name!r} of a line before it' if name else 'no name'}")
        names[name] = None
        rows.append([_number(record, columns[column], column, where) for column in (*POSITION, *angles)])
    if not rows:
        raise SceneError(f"{path} has no cameras, but must have a line for each")
    values = torch.tensor(rows, dtype=torch.float64)
    return Viewpoints(tuple(names), values[:, :3], _rotation(values[:, 3:].deg2rad(), angles))


def _rotation(values: Float[Tensor, "m a"], angles: Sequence[str]) -> Float[Tensor, "m 3 3"] | None:
    if not angles:
        return None
    return rotation_of_angles(values) if angles == OPK else cam_from_world(*values.unbind(dim=-1), mount=Mount.DOWN)


def _records(path: Path) -> tuple[Mapping[str, int], list[tuple[int, list[str]]]]:
    """Where each column is, and the lines with their numbers."""
    if not path.is_file():
        raise SceneError(f"{path} does not exist, but cameras must be a folder, an XML file or a table")
    if path.stat().st_size > MOST_MEGABYTES * MEGABYTE:
        raise SceneError(f"{path} has more than {MOST_MEGABYTES} MB; is it the right file?")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise SceneError(f"{path} is no text in UTF-8, but cameras must be a folder, an XML file or a table") from None
    numbered = [(i, line) for i, line in enumerate(text.splitlines(), start=1) if line.strip() and line[0] != "#"]
    if not numbered:
        raise SceneError(f"{path} has no cameras, but must have a line for each")
    most = max("\t,;", key=numbered[0][1].count)
    split = [(i, _parts(line, most if most in numbered[0][1] else None)) for i, line in numbered]
    plain = [title.strip().lower() for title in split[0][1]]
    named = {name: i for name, aliases in ALIASES.items() for i, title in enumerate(plain) if title in aliases}
    if all(name in named for name in POSITION) or len(plain) < 4 or not _is_number(plain[1]):
        return named, split[1:]
    count = len(WITHOUT_HEAD) if len(plain) >= len(WITHOUT_HEAD) else 1 + len(POSITION)
    return {name: i for i, name in enumerate(WITHOUT_HEAD[:count])}, split


def _parts(line: str, separator: str | None) -> list[str]:
    return line.split() if separator is None else next(csv.reader(io.StringIO(line), delimiter=separator))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _number(record: Sequence[str], column: int, name: str, where: str) -> float:
    text = record[column].strip() if column < len(record) else ""
    value = float(text) if _is_number(text) else math.nan
    if not abs(value) <= FARTHEST:
        raise SceneError(f"{where}: {name} is {text[:40]!r}, but must be a number")
    return value
