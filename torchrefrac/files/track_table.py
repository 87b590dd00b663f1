"""Tracks of points in images as other programs make them, a CSV file of frame, id, view, x, y; and the points that came
of them, as another."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path, PurePath

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.files.control_points import numbers_of
from torchrefrac.files.fields import FARTHEST
from torchrefrac.refinement import PointEstimate
from torchrefrac.scene import CaptureError, Observations

COLUMNS = ("frame", "id", "view", "x", "y")
POINT_COLUMNS = (
    "frame", "id", "X", "Y", "Z", "sigma_X", "sigma_Y", "sigma_Z", "views", "set_aside", "error_px",
)  # fmt: skip
WHAT = f"a CSV file of tracks, with the columns {', '.join(COLUMNS)}"
MOST_NAMED = 6  # images in a sentence
LENGTH, SIGMA = "{:.10g}", "{:.6g}"


@dataclass(frozen=True, eq=False)
class TrackTable:
    """The frame and the id of each point (n), as the file has them, and where it was seen."""

    names: Sequence[tuple[str, str]]
    observations: Observations


def read_track_table(path: Path, views: Sequence[str], shift: float) -> TrackTable:
    """Points in the order in which they come first. views: names of images, which the file may give without ending;
    shift: of pixels from those of the file to those in here.

    Raises CaptureError, with the line, for a column that is missing, a view that is unknown, a point that a view sees
    twice and what is no number.
    """
    number_of, points = view_numbers(views), {}
    point, view, places, lines = [], [], [], []
    for line, frame, name, image, x, y in _rows(path):
        number = number_of.get(image)
        if number is None:
            known = ", ".join(views[:MOST_NAMED]) + (", ..." if len(views) > MOST_NAMED else "")
            raise CaptureError(f"{path}: line {line}: view is {image[:100]!r}, but the run has placed {known}")
        point.append(points.setdefault((frame, name), len(points)))
        view.append(number)
        places.append((x, y))
        lines.append(line)
    if not lines:
        raise CaptureError(f"{path} has no line but the first; it must be {WHAT}")
    names, pixels = tuple(points), _numbers(places, lines, path) + shift
    seen = Observations(torch.tensor(view), torch.tensor(point), pixels)
    again = _first_repeat(seen.point * len(views) + seen.view)
    if again is not None:
        frame, name = names[point[again]]
        where, image = f"{path}: line {lines[again]}", views[view[again]]
        raise CaptureError(f"{where} has {name} in frame {frame} of {image} again; leave one of them")
    return TrackTable(names, seen)


def write_track_points(
    path: Path,
    names: Sequence[tuple[str, str]],
    estimate: PointEstimate,
    set_aside: Int[Tensor, " n"],
    wanted: Bool[Tensor, " n"],
) -> None:
    """Those of n points that are `wanted`, with standard deviations along the axes, how many views they rest on, how
    many observations were set aside, and their reprojection errors (RMS, px); whole or not at all."""
    rows = wanted.nonzero()[:, 0]
    sigma = estimate.covariance.diagonal(dim1=1, dim2=2).clamp(min=0.0).sqrt()
    columns = (estimate.points, sigma, estimate.num_views, set_aside, estimate.rms)
    values = zip(rows.tolist(), *(column[rows].tolist() for column in columns), strict=True)
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(POINT_COLUMNS)
        for row, place, deviation, count, left_out, error in values:
            lengths = (*map(LENGTH.format, place), *map(SIGMA.format, deviation))
            table.writerow((*names[row], *lengths, count, left_out, SIGMA.format(error)))


def _rows(path: Path) -> Iterator[tuple[int, str, str, str, str, str]]:
    """The number of each line that is not empty, and its texts of COLUMNS."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = file.readline()
            separator = max(",;\t", key=first.count)
            titles = [title.strip().lower() for title in next(csv.reader([first], delimiter=separator), [])]
            missing = [name for name in COLUMNS if name not in titles]
            if missing:
                needed = ", ".join(COLUMNS)
                raise CaptureError(f"{path} has no column {missing[0]}; its first line must name {needed}")
            pick, table = itemgetter(*map(titles.index, COLUMNS)), csv.reader(file, delimiter=separator)
            for texts in table:
                if len(texts) == len(titles):
                    frame, name, image, x, y = pick(texts)
                    yield table.line_num + 1, frame.strip(), name.strip(), image.strip(), x, y
                elif texts:
                    where = f"{path}: line {table.line_num + 1}"
                    raise CaptureError(f"{where} has {len(texts)} columns, but the first line names {len(titles)}")
    except FileNotFoundError:
        raise CaptureError(f"{path} does not exist, but must be {WHAT}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise CaptureError(f"{path} cannot be read as {WHAT}: {error}") from None


def _numbers(places: Sequence[tuple[str, str]], lines: Sequence[int], path: Path) -> Float[Tensor, "k 2"]:
    """Texts of x and y, all at once where each is a number; else one by one, to say which is none."""
    try:
        values = torch.tensor([(float(x), float(y)) for x, y in places], dtype=torch.float64)
    except ValueError:
        values = torch.full((1, 2), torch.nan, dtype=torch.float64)
    if bool((values.abs() <= FARTHEST).all()):
        return values
    found = zip(places, lines, strict=True)
    each = [numbers_of(place, ("x", "y"), f"{path}: line {line}") for place, line in found]
    return torch.tensor(each, dtype=torch.float64)


def _first_repeat(keys: Int[Tensor, " k"]) -> int | None:
    """The first place of a key that stands before it already."""
    order = keys.argsort(stable=True)
    repeats = order[1:][keys[order].diff() == 0]
    return int(repeats.min()) if len(repeats) else None


def view_numbers(views: Sequence[str]) -> dict[str, int]:
    """Views by their names, and without ending where no other is called so."""
    stems = [PurePath(name).with_suffix("").as_posix() for name in views]
    short = {stem: i for i, stem in enumerate(stems) if stems.count(stem) == 1}
    return short | {name: i for i, name in enumerate(views)}
