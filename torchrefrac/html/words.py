"""Numbers and sentences of a report: no more digits than mean something."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from torchrefrac.figures.plotting import UNKNOWN, rounded
from torchrefrac.figures.side_views import TITLES
from torchrefrac.files.run import RunRecord, RunStatus
from torchrefrac.files.swap import home
from torchrefrac.scene import Capture, Interfaces
from torchrefrac.scene.interfaces import SURFACE, WALL
from torchrefrac.scene.wording import INTERFACE, Wording, wording

MODELS = {
    "none": "as if there were no water",
    "radial": "as if the camera made what the water does: radial distortion refined",
    "bundler": "as Bundler does: focal length and radial distortion of each photograph refined, from its EXIF alone",
    "refractive": "with refraction {at}, exactly",
}
ENDS = {
    RunStatus.FAILED: "Failed",
    RunStatus.INTERRUPTED: "Interrupted",
    RunStatus.RUNNING: "Not finished: still running, or ended without a record;",
}
MINUTE = 60.0
LEAST_TILT_DEG = 0.005


def with_sigma(value: float, sigma: float | None) -> str:
    """A value with its standard deviation, both to the digit that this leaves; an index ratio without one is plain."""
    if sigma is None:
        return plain(value)
    if not 0.0 < sigma < math.inf:
        return rounded(value, 5)
    power = math.floor(math.log10(sigma))
    decimals = max(0, -power + (1 if sigma < 2.0 * 10.0**power else 0))
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}"


def capital(words: str) -> str:
    """As at the beginning of a sentence."""
    return f"{words[:1].upper()}{words[1:]}"


def plain(value: float) -> str:
    """An index ratio: four decimals, fewer where they are zero."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


def counted(count: int) -> str:
    """A whole number with thin spaces between its thousands."""
    return f"{count:,}".replace(",", "\u202f")


def sizes(capture: Capture) -> str:
    """How many photographs there are of which size."""
    counts = Counter(capture.cameras.sizes[row] for row in capture.camera.tolist())
    return " and ".join(f"{count} of {width} \u00d7 {height}" for (width, height), count in counts.most_common())


def positions(capture: Capture | None, record: RunRecord) -> str:
    """Of how many photographs they are stated, and how far the cameras are from them; nothing where none is stated."""
    stated = 0 if capture is None else int(capture.position_sigma.isfinite().all(dim=-1).sum())
    if capture is None or not stated:
        return ""
    unit, words = capture.length_unit, [f"stated of {stated} photographs"]
    found = [record.number(f"position_rms_{name}{unit}") for name in ("", "vertical_")]
    if None not in found:
        across, up = (f"{rounded(value or 0.0)} {unit}" for value in found)
        words.append(f"cameras are {across} from them across and {up} in height (RMS)")
    level = record.number(f"water_level_{unit}")
    return "; ".join([*words, *([] if level is None else [f"the water stands at {level:.2f} {unit} among them"])])


def model_words(model: str, of_kind: Wording) -> str:
    """What a model does; nothing of one that nobody knows."""
    return MODELS.get(model, "").format(at=of_kind.model)


def models_words(records: Sequence[RunRecord]) -> dict[str, str]:
    """What the models of runs do, by their titles; at what refracts in the first run with this model."""
    first = {record.model: record for record in reversed(records)}
    return {
        model_title(model): model_words(model, wording(first[model].metrics.get(INTERFACE, SURFACE)))
        for model in MODELS
        if model in first
    }


def interfaces(capture: Capture | None) -> str:
    """What is looked through, as it is stated; nothing where that is one surface of water."""
    if capture is None or set(capture.interfaces.kinds) == {SURFACE}:
        return ""
    table = capture.interfaces
    every = [_interface(table, row, capture.length_unit) for row in range(len(table))]
    return "; ".join(every)


def upright(record: RunRecord) -> str:
    """How upright a wall is by gravity; nothing of what is none."""
    off, sigma = (record.number(f"wall_upright_{name}_deg") for name in ("off", "sigma"))
    return "" if off is None or sigma is None else f"the wall is {rounded(off)}° from it, ± {rounded(sigma)}°"


def _interface(table: Interfaces, row: int, unit: str) -> str:
    layers = zip(table.thickness[row].tolist(), table.layers[row].tolist(), strict=True)
    glass = [f"{thickness:.4g} {unit} of glass ({plain(index)})" for thickness, index in layers if thickness > 0.0]
    panes = " and ".join(glass) or "no glass that counts"
    water = f"before water of {plain(float(table.index_ratio[row]))}"
    if table.kinds[row] == WALL:
        return f"a wall of {panes} {water}"
    if table.kinds[row] == SURFACE:
        return f"a surface of water of {plain(float(table.index_ratio[row]))}"
    tilt = math.degrees(math.acos(min(1.0, -float(table.normal[row, 2]))))
    turned = f", tilted by {tilt:.2g}°" if tilt > LEAST_TILT_DEG else ""
    return f"a flat port {-float(table.offset[row]):.4g} {unit} ahead{turned}, of {panes} {water}"


def seconds(value: float) -> str:
    """A duration."""
    if value < MINUTE:
        return f"{value:.1f} s"
    whole = round(value)
    if whole < MINUTE * MINUTE:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def file_size(count: int) -> str:
    """Of a file of so many bytes."""
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{max(1, round(count / 1e3))} kB"


def model_title(model: str) -> str:
    return TITLES.get(model, model) or "?"


def model_order(record: RunRecord) -> tuple[int, str]:
    """Sorts the models from none to refractive, then by folder."""
    models = list(MODELS)
    return models.index(record.model) if record.model in models else len(models), record.folder.name


def distinct(titles: Sequence[str], records: Sequence[RunRecord]) -> list[str]:
    """The titles of runs, with the folder where several have the same."""
    return [
        title if titles.count(title) == 1 else f"{title} [{record.folder.name}]"
        for title, record in zip(titles, records, strict=True)
    ]


def verdict(record: RunRecord, unit: str) -> str:
    """What became of a run, in one sentence."""
    metrics = record.metrics
    if not record.is_complete:
        return _ended(record)
    parts = [f"{placed_words(metrics, ' of ')} photographs placed"]
    error = metrics.get(f"camera_rms_{unit}")
    if error is not None:
        parts.append(f"cameras within {rounded(error)} {unit} of the truth (RMS)")
    elif metrics.get("reprojection_median_px") is not None:
        parts.append(f"median reprojection error {rounded(metrics['reprojection_median_px'])} px")
    return "; ".join([*parts, *index_ratio_words(record)]) + "."


def placed_words(metrics: Mapping[str, Any], between: str = "/") -> str:
    """How many photographs have a place, of how many."""
    count = metrics.get("registered_images", metrics.get("adjusted_images"))
    return UNKNOWN if count is None else f"{count}{between}{metrics.get('images', '?')}"


def index_ratio_words(record: RunRecord) -> list[str]:
    """What to say of the index ratio: nothing where the model has no water."""
    metrics = record.metrics
    ratio, truth = metrics.get("index_ratio"), metrics.get("true_index_ratio")
    if ratio is None:
        return []
    if record.model != "refractive":
        return ["the water is left out of account" + (f" (true index ratio {plain(truth)})" if truth else "")]
    sigma = metrics.get("index_ratio_sigma")
    assumed = " assumed" if sigma is None else ""
    return [f"index ratio {with_sigma(ratio, sigma)}{assumed}" + (f" (true {plain(truth)})" if truth else "")]


def _ended(record: RunRecord) -> str:
    begun = f"after {_listed(record.stages)}" if record.stages else "before the first stage was complete"
    known = record.status is not RunStatus.UNKNOWN
    sentence = f"{ENDS[record.status]} {begun}" if known else "Nothing is known about this run"
    reason = record.reason.rstrip(".")
    return sentence + (f": {reason}." if reason else ".")


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def job_name(record: RunRecord) -> str:
    """What a run is called beside others: scene and model."""
    title = model_title(record.model) if record.model else ""
    return ": ".join(filter(None, (record.scene, title))) or home(record.folder.resolve()).name
