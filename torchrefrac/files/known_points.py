"""Points whose places are known, and where they are seen: a CSV file with the columns X, Y, Z, view, x, y."""

import csv
from collections.abc import Sequence
from pathlib import Path

import torch

from torchrefrac.files.control_points import numbers_of, text_lines
from torchrefrac.files.track_table import view_numbers
from torchrefrac.scene import CaptureError, Observations
from torchrefrac.scene.known import KnownPoints

COLUMNS = ("X", "Y", "Z", "view", "x", "y")


def read_known_points(path: Path, names: Sequence[str], shift: float) -> KnownPoints:
    """The points of a file, those of one place being one, and their pixels in the images `names`, which may be named
    without their ending. shift: from the file's pixels to those of this package.

    Raises CaptureError, with the line, for whatever cannot be right.
    """
    lines = text_lines(path, f"a CSV file of known points, with the columns {', '.join(COLUMNS)}")
    (_, first), *rest = lines
    separator = max(",;\t", key=first.count)
    titles = [title.strip() for title in next(csv.reader([first], delimiter=separator))]
    missing = [name for name in COLUMNS if name not in titles]
    if missing:
        raise CaptureError(f"{path} has no column {missing[0]}; its first line must name {', '.join(COLUMNS)}")
    at = [titles.index(name) for name in COLUMNS]
    known = view_numbers(names)
    places: dict[tuple[float, ...], int] = {}
    point, view, pixels, seen = [], [], [], set()
    for number, line in rest:
        where, texts = f"{path}: line {number}", next(csv.reader([line], delimiter=separator))
        if len(texts) != len(titles):
            raise CaptureError(f"{where} has {len(texts)} columns, but the first line names {len(titles)}")
        *place, name, x, y = (texts[i].strip() for i in at)
        if name not in known:
            raise CaptureError(f"{where}: view is {name[:40]!r}, but must be one of {', '.join(names[:3])}, ...")
        row = places.setdefault(tuple(numbers_of(place, COLUMNS[:3], where)), len(places))
        if (row, known[name]) in seen:
            raise CaptureError(f"{where}: {name} has seen this point in a line before; leave one of them")
        seen.add((row, known[name]))
        point.append(row)
        view.append(known[name])
        pixels.append([value + shift for value in numbers_of((x, y), ("x", "y"), where)])
    order = sorted(range(len(point)), key=point.__getitem__)
    observed = Observations(
        torch.tensor([view[i] for i in order], dtype=torch.long),
        torch.tensor([point[i] for i in order], dtype=torch.long),
        torch.tensor([pixels[i] for i in order], dtype=torch.float64).reshape(-1, 2),
    )
    return KnownPoints(torch.tensor([*places], dtype=torch.float64).reshape(-1, 3), observed)
