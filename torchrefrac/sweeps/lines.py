"""The lines of a sweep's figure: jobs that differ only in what is along the axis, and how they look."""

from collections.abc import Sequence
from dataclasses import dataclass

from torchrefrac.figures.side_views import MODEL_COLORS, TITLES
from torchrefrac.files.run import RunRecord
from torchrefrac.sweeps.design import Design, short_keys, value_of

OTHER_COLORS = ("#e69f00", "#56b4e9", "#000000")
MARKERS = {"none": "o", "radial": "s", "bundler": "v", "refractive": "D"}
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1.2)), (0, (4, 1.5, 1, 1.5)))
PALEST = 0.6  # share of white in the last of several lines of one model


@dataclass(frozen=True)
class Line:
    """Jobs of one label, of all scenes; color as RGB from 0 to 1, dash as matplotlib's linestyle."""

    label: str
    color: tuple[float, float, float]
    marker: str
    dash: str | tuple[float, tuple[float, ...]]
    jobs: tuple[RunRecord, ...]


@dataclass(frozen=True)
class Spot:
    """The jobs of a line at one place of the axis (more than one where seeds vary): those with values, and failures.

    values: a metric of the complete jobs; partial: whether one of them did not register all of its images.
    """

    x: float
    values: tuple[float, ...]
    partial: bool
    failures: int

    @property
    def mean(self) -> float:
        """NaN where there is no value, which leaves a gap in a line."""
        return sum(self.values) / len(self.values) if self.values else float("nan")


def lines_of(jobs: Sequence[RunRecord], design: Design) -> list[Line]:
    """A line for each model and each combination of what else differs, in the order of the jobs.

    A model has the same colour in all figures; several lines of one model differ by shade and dashes.
    """
    known = [job for job in jobs if job.model or job.overrides]
    groups: dict[tuple[str, ...], list[RunRecord]] = {}
    for job in known:
        groups.setdefault((job.model, *(job.overrides.get(key, "") for key in design.distinguished)), []).append(job)
    models = list(dict.fromkeys(job.model for job in known))
    strangers = [model for model in models if model not in MODEL_COLORS]
    lines = []
    for group, members in groups.items():
        model = group[0]
        alike = [other for other in groups if other[0] == model]
        order = alike.index(group)
        color = MODEL_COLORS.get(model) or OTHER_COLORS[strangers.index(model) % len(OTHER_COLORS)]
        white = PALEST * order / max(len(alike) - 1, 1)
        label = _label(model, group[1:], design, len(models) > 1)
        dash = DASHES[order % len(DASHES)]
        lines.append(Line(label, _paler(color, white), MARKERS.get(model, "^"), dash, tuple(members)))
    return lines


def places_of(lines: Sequence[Line], x: str) -> list[float]:
    """All places along the axis of numbers, from left to right."""
    return sorted({place for line in lines for job in line.jobs if (place := value_of(job, x)) is not None})


def spots_of(
    line: Line, scene: str, x: str | None, metric: str, position: float, expected: Sequence[float] = ()
) -> list[Spot]:
    """A scene's jobs of a line by their place along the axis, from left to right; all at `position` without a key x.

    There is an empty spot at each place of `expected` where the line has no job.
    """
    places: dict[float, list[RunRecord]] = {place: [] for place in expected}
    for job in line.jobs:
        place = position if x is None else value_of(job, x)
        if job.scene == scene and place is not None:
            places.setdefault(place, []).append(job)
    return [_spot(place, places[place], metric) for place in sorted(places)]


def _spot(place: float, jobs: Sequence[RunRecord], metric: str) -> Spot:
    shown = [(job, value) for job in jobs if job.is_complete and (value := _measured(job, metric)) is not None]
    failures = sum(not job.is_complete for job in jobs)
    return Spot(place, tuple(value for _, value in shown), any(is_partial(job) for job, _ in shown), failures)


def _measured(job: RunRecord, metric: str) -> float | None:
    return _registered_share(job) if metric == "registered_share" else job.number(metric)


def _registered_share(job: RunRecord) -> float | None:
    """Registered images of all, in per cent."""
    registered, images = job.number("registered_images"), job.number("images")
    return 100.0 * registered / images if registered is not None and images else None


def is_partial(job: RunRecord) -> bool:
    """Whether images of the job are known to have no place."""
    share = _registered_share(job)
    return share is not None and share < 100.0


def _label(model: str, values: Sequence[str], design: Design, several_models: bool) -> str:
    short = short_keys(design.keys)
    words = [TITLES.get(model, model or "unknown model")] if several_models or not values else []
    for key, value in zip(design.distinguished, values, strict=True):
        words.append(f"{short[key]} {value or '-'}" if "." in key or not value else value)
    return ", ".join(words)


def _paler(color: str, white: float) -> tuple[float, float, float]:
    red, green, blue = (int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return red + white * (1.0 - red), green + white * (1.0 - green), blue + white * (1.0 - blue)
