"""The tables of a report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from torchrefrac.evaluate.metrics import camera_prefixes
from torchrefrac.figures.residuals import Residuals
from torchrefrac.figures.shift import off_nadir
from torchrefrac.figures.uncertainty import true_errors
from torchrefrac.files.run import PAGES, RunRecord, is_number
from torchrefrac.html.contents import RunContents
from torchrefrac.html.page import thumbnail
from torchrefrac.html.words import UNKNOWN, file_size, placed_words, rounded, seconds, with_sigma

PLACED = ("placed", "photographs with a pose, of all of them")
REPROJECTION = "distance between where a point is seen and where the reconstruction puts it, median"
ERRORS = (
    ("camera error", "camera_rms", "RMS distance of the camera centres from the true ones, after aligning them"),
    ("3D error", "point_median", "distance of a point from what the cameras truly saw there, median"),
    ("flatness", "flatness", "how far the points of a true plane are from one plane, wherever that is"),
    ("off surface", "surface_median", "distance of a point from the true surface, median"),
)
AMOUNTS = (("points", "points", "tie points of the sparse model"), ("time", "seconds_total", "of the whole run"))


@dataclass(frozen=True)
class Cell:
    """text, where it leads, and whether it is the best of its column."""

    text: str
    link: str = ""
    best: bool = False


@dataclass(frozen=True)
class Table:
    """Heads, and rows of cells; `marked` rows stand out; terms: heads, without units, with what they mean."""

    heads: list[str]
    rows: list[list[Cell]]
    marked: tuple[int, ...] = ()
    terms: tuple[tuple[str, str], ...] = ()

    @property
    def has_errors(self) -> bool:
        """Whether any column compares runs with the truth."""
        return not {name for name, *_ in ERRORS}.isdisjoint(name for name, _ in self.terms)


@dataclass(frozen=True)
class Entry:
    """A run in Table 1: what it is called, its record, and where its own report is (empty: here)."""

    label: str
    record: RunRecord
    link: str = ""


def table1(entries: Sequence[Entry], unit: str, marked: int | None = None, digits: int = 2) -> Table:
    """The paper's Table 1 of complete runs of one scene: errors against truth, to so many significant digits, and what
    is known without it.

    Columns that no run has are left out; the smallest error of a column is marked as the best where there are several.
    """
    columns: list[tuple[str, str, Callable[[float], str], bool]] = [
        (f"{name} ({unit})", f"{key}_{unit}", lambda value: rounded(value, digits), True) for name, key, _ in ERRORS
    ]
    columns += [("reprojection (px)", "reprojection_median_px", rounded, True)]
    columns += [("points", "points", lambda value: f"{value:.0f}", False), ("time", "seconds_total", seconds, False)]
    columns = [column for column in columns if any(entry.record.number(column[1]) is not None for entry in entries)]
    placed = [placed_words(e.record.metrics) if e.record.is_complete else e.record.status for e in entries]
    rows = [[Cell(entry.label, entry.link), Cell(text)] for entry, text in zip(entries, placed, strict=True)]
    for _, key, words, is_error in columns:
        values = [entry.record.number(key) for entry in entries]
        known = [value for value in values if value is not None]
        least = min(known) if is_error and len(known) > 1 else None
        for row, value in zip(rows, values, strict=True):
            row.append(Cell(UNKNOWN if value is None else words(value), best=least is not None and value == least))
    for row, entry in zip(rows, entries, strict=True):
        row.append(Cell(_index_ratio(entry.record)))
    heads = ["model", "placed", *(name for name, *_ in columns), "index ratio"]
    keys = {key for _, key, *_ in columns}
    terms = [PLACED, *((name, words) for name, key, words in ERRORS if f"{key}_{unit}" in keys)]
    if "reprojection_median_px" in keys:
        terms.append(("reprojection", REPROJECTION))
    terms += [(name, words) for name, key, words in AMOUNTS if key in keys]
    terms.append(("index ratio", "of the water to the air, with its standard deviation where it was estimated"))
    return Table(heads, rows, () if marked is None else (marked,), tuple(terms))


def _index_ratio(record: RunRecord) -> str:
    ratio = record.number("index_ratio") if record.model == "refractive" else None
    return UNKNOWN if ratio is None else with_sigma(ratio, record.number("index_ratio_sigma"))


def cameras(contents: RunContents) -> Table | None:
    """The cameras of the capture, as stated and as found; None where there is one that counts as exact."""
    capture, scene = contents.capture, contents.scene
    if capture is None or (len(capture.cameras) == 1 and not capture.cameras.are_uncertain):
        return None
    stated, rows = capture.cameras, []
    placed = None if scene is None else capture.camera[scene.views.registered]
    for row, prefix in enumerate(camera_prefixes(stated)):
        focal, (width, height) = float(stated.focal[row, 0]), stated.sizes[row]
        found, sigma = (contents.record.number(f"{prefix}_focal{of}_px") for of in ("", "_sigma"))
        texts = [stated.names[row], stated.models[row], f"{width} \u00d7 {height}"]
        count = int((capture.camera == row).sum())
        used = count if placed is None else int((placed == row).sum())
        texts.append(str(count) if placed is None else f"{used} of {count}")
        texts.append(with_sigma(focal, focal * float(stated.focal_sigma[row])))
        texts.append(_found(scene is not None, used, found, sigma))
        rows.append([Cell(text) for text in texts])
    heads = ["camera", "model", "size (px)", "photographs" if placed is None else "photographs placed"]
    terms = (
        ("model", "of the distortion of the lens"),
        ("focal length stated", "along x, with the standard deviation that the capture states"),
        ("found", "the same after the adjustment, with its standard deviation"),
    )
    return Table([*heads, "focal length stated (px)", "found (px)"], rows, terms=terms)


def _found(is_done: bool, used: int, focal: float | None, sigma: float | None) -> str:
    """What a finished run has made of a camera's focal length, by so many of its photographs."""
    if not is_done:
        return UNKNOWN
    if not used:
        return "not used"
    return "as stated" if focal is None else with_sigma(focal, sigma)


@dataclass(frozen=True)
class Photograph:
    """A row of the table of images; cells as `photograph_columns` says."""

    number: int
    name: str
    picture: str
    placed: bool
    reason: str
    cells: list[str]


def photograph_columns(contents: RunContents) -> Table:
    """The heads of what the cells of each placed photograph are, and what they mean; without rows."""
    unit, scene, words = contents.unit, contents.shown, contents.words
    columns = [
        (words.height, unit, "of the camera centre"),
        (words.off_axis, "°", "how far the optical axis is turned away from it"),
        ("observations", "", "how many points are seen in it"),
        ("median error", "px", "distance between where points are seen and where the reconstruction puts them"),
        ("incidence, 5 to 95 %", "°", f"{words.incidence} of all rays but the flattest and the steepest"),
    ]
    if scene is not None and scene.assessment.center_covariance is not None:
        columns.append(("centre known to", unit, "standard deviation of a coordinate of the camera centre"))
    if contents.truth is not None:
        columns.append(("true error", unit, "distance of the camera centre from the true one, after aligning all"))
    heads = [f"{name} ({of})" if of else name for name, of, _ in columns]
    return Table(heads, [], terms=tuple((name, meaning) for name, _, meaning in columns))


def photographs(contents: RunContents, residuals: Residuals | None) -> list[Photograph]:
    """The table of images; before there are cameras the names, and pictures, of the capture."""
    scene, capture = contents.shown, contents.capture
    names = scene.views.names if scene is not None else capture.names if capture is not None else ()
    paths = dict(zip(capture.names, capture.paths, strict=True)) if capture is not None else {}
    cells = {} if scene is None else _placed_cells(contents, residuals)
    return [
        Photograph(
            number=i + 1,
            name=name,
            picture=thumbnail(paths[name]) if name in paths else "",
            placed=i in cells,
            reason="" if scene is None else scene.failures.get(name, ""),
            cells=cells.get(i, []),
        )
        for i, name in enumerate(names)
    ]


def _placed_cells(contents: RunContents, residuals: Residuals | None) -> dict[int, list[str]]:
    scene = contents.shown
    if scene is None:
        return {}
    images = scene.views.registered.nonzero()[:, 0]
    tilt, covariance = off_nadir(scene), scene.assessment.center_covariance
    errors = None if contents.truth is None else true_errors(scene, contents.truth, images).norm(dim=-1).tolist()
    cells = {}
    for row, i in enumerate(images.tolist()):
        cells[i] = [rounded(float(scene.views.center[i, 2]), 4), f"{float(tilt[i]):.1f}", *_seen(residuals, i)]
        if covariance is not None:
            cells[i].append(rounded(float(covariance[row].trace() / 3.0) ** 0.5))
        if errors is not None:
            cells[i].append(rounded(errors[row]))
    return cells


def _seen(residuals: Residuals | None, image: int) -> list[str]:
    """Observations, median error, range of angles."""
    own = None if residuals is None else residuals.of_image(image)
    if own is None or not len(own):
        return [UNKNOWN] * 3
    low, high = own.incidence.quantile(torch.tensor((0.05, 0.95), dtype=torch.float64)).tolist()
    return [str(len(own)), rounded(float(own.error.median())), f"{low:.0f} to {high:.0f}"]


@dataclass(frozen=True)
class Bar:
    """A bar of a chart in the page: its share of the longest in per cent."""

    name: str
    text: str
    percent: float


def timings(record: RunRecord) -> list[Bar]:
    """The seconds of each stage, and what is left of the total."""
    start, total = "seconds_", record.number("seconds_total") or 0.0
    parts = {
        key.removeprefix(start): float(value)
        for key, value in record.metrics.items()
        if key.startswith(start) and key != "seconds_total" and is_number(value)
    }
    rest = total - sum(parts.values())
    if parts and rest > 0.01 * total:
        parts["everything else"] = rest
    longest = max(parts.values(), default=0.0) or 1.0
    return [Bar(name.replace("_", " "), seconds(value), 100.0 * value / longest) for name, value in parts.items()]


def files_of(folder: Path) -> list[Cell]:
    """Links to the files of a run, relative to its folder, with their sizes."""
    found = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    return [file_link(path) for path in found if path.name not in PAGES]


def file_link(path: Path) -> Cell:
    """A link to a file of the folder in which the page lies, with its size."""
    return Cell(f"{path.name} ({file_size(path.stat().st_size)})", path.name)
