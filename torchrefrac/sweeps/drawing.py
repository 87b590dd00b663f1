"""What the panels of a sweep's figure are made of: axes, lines and their spots, reference lines, the legend."""

import math
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from torchrefrac.figures.plotting import legend_key
from torchrefrac.figures.side_views import INK
from torchrefrac.files.run import RunRecord
from torchrefrac.sweeps.design import Design, value_of
from torchrefrac.sweeps.lines import Line, Spot, is_partial, places_of

SCENE_RATIO = "scene.index_ratio"
TRUE_STYLE: dict[str, Any] = {"color": "#777777", "lw": 1.2, "ls": "--"}
AIR_STYLE = TRUE_STYLE | {"ls": ":"}
LOG_SPAN = 30.0  # a range of more than this is drawn on a logarithmic scale
FEWEST = 3  # spots of a line of which the smallest is worth a mark


def assumes_ratio(design: Design) -> bool:
    """Whether the axis is an index ratio that the reconstruction assumed."""
    return design.x is not None and design.x.endswith("index_ratio") and design.x != SCENE_RATIO


def has_air(jobs: Sequence[RunRecord], design: Design) -> bool:
    """Whether the axis is the true index ratio, and 1, no refraction at all, is among its values."""
    return design.x == SCENE_RATIO and any(value_of(job, SCENE_RATIO) == 1.0 for job in jobs)


def draw_spots(panel: Any, spots: Sequence[Spot], line: Line, design: Design, count: int) -> None:
    """One line of `count`, broken where jobs failed, and a marker for every job.

    Where a spot has several jobs the line runs through their means, and a band (bars without an axis of numbers) shows
    from the smallest to the largest.
    """
    several = [spot for spot in spots if len(spot.values) > 1]
    if design.x is not None:
        x = [spot.x for spot in spots]
        panel.plot(x, [spot.mean for spot in spots], color=line.color, ls=line.dash, lw=1.6, zorder=3)
        low = [min(spot.values, default=float("nan")) for spot in spots]
        high = [max(spot.values, default=float("nan")) for spot in spots]
        if several:
            panel.fill_between(x, low, high, color=line.color, alpha=0.18, lw=0, zorder=2)
    for spot in several:
        panel.plot([spot.x] * len(spot.values), spot.values, line.marker, ms=3, color=line.color, alpha=0.6, zorder=3)
        panel.plot((spot.x, spot.x), (min(spot.values), max(spot.values)), color=line.color, lw=1.0, zorder=3)
    for spot in spots:
        if spot.values:
            inside = "white" if spot.partial else line.color
            panel.plot(spot.x, spot.mean, line.marker, ms=5.5, mew=1.3, mec=line.color, mfc=inside, zorder=4)
            if design.x is None and count <= 6:
                _write_beside(panel, f"{spot.mean:.3g}", spot, (7, 0), va="center")
    known = [spot for spot in spots if spot.values]
    if assumes_ratio(design) and len(known) >= FEWEST:
        best = min(known, key=lambda spot: spot.mean)
        panel.plot(best.x, best.mean, "o", ms=12, mfc="none", mec=line.color, mew=1.2, zorder=4)
        if count == 1:
            _write_beside(panel, f"{best.x:g}", best, (0, 10), ha="center")


def _write_beside(panel: Any, text: str, spot: Spot, by: tuple[int, int], **how: Any) -> None:
    panel.annotate(text, (spot.x, spot.mean), by, textcoords="offset points", fontsize=8, color=INK, **how)


def draw_true_ratio(panel: Any, jobs: Sequence[RunRecord], design: Design) -> None:
    """A vertical line: the scene's true index ratio over assumed ones, or, over true ones, that of no water."""
    if assumes_ratio(design):
        for ratio in sorted({ratio for job in jobs if (ratio := job.number("true_index_ratio")) is not None}):
            low, high = panel.get_xlim()
            panel.set_xlim(min(low, ratio - 0.03 * (high - low)), max(high, ratio + 0.03 * (high - low)))
            panel.axvline(ratio, zorder=1, **TRUE_STYLE)
    elif has_air(jobs, design):
        panel.axvline(1.0, zorder=1, **AIR_STYLE)


def legend_handles(jobs: Sequence[RunRecord], design: Design, lines: Sequence[Line]) -> list[Any]:
    """What the figure's marks mean; lines only where the axis does not name them."""
    complete = [job for job in jobs if job.is_complete]
    handles = []
    if design.x is not None:
        handles = [legend_key(color=x.color, ls=x.dash, marker=x.marker, ms=5.5, label=x.label) for x in lines]
    if design.averaged:
        handles.append(legend_key(color=INK, alpha=0.25, lw=7, label="mean, range of seeds"))
    if assumes_ratio(design):
        if any(job.number("true_index_ratio") is not None for job in complete):
            handles.append(legend_key(label="true index ratio", **TRUE_STYLE))
        handles.append(legend_key(ls="", marker="o", ms=10, mfc="none", mec=INK, label="smallest of its line"))
    elif has_air(complete, design):
        handles.append(legend_key(label="index ratio 1: all agree", **AIR_STYLE))
    if any(is_partial(job) for job in complete):
        handles.append(legend_key(ls="", marker="o", mfc="white", mec=INK, label="not all images registered"))
    if len(complete) < len(jobs):
        label = f"failed: {len(jobs) - len(complete)} of {len(jobs)} jobs"
        handles.append(legend_key(ls="", marker="x", ms=6, mew=1.6, color=INK, label=label))
    return handles


def set_heights(panel: Any, values: Sequence[float]) -> None:
    """The vertical axis of a panel: logarithmic where the values of the panels with one unit span much; else from 0."""
    from matplotlib.ticker import FuncFormatter  # noqa: PLC0415 - slow to import

    if not values or max(values) <= 0.0:
        panel.set_ylim(0.0, 1.0)
        return
    low, high = min(values), max(values)
    if low > 0.0 and high / low > LOG_SPAN:
        room = (high / low) ** 0.08
        panel.set_yscale("log")
        panel.set_ylim(low / room**1.5, high * room**1.5)
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    else:
        panel.set_ylim(min(0.0, 1.1 * low), 1.15 * high)


def set_places(panel: Any, design: Design, lines: Sequence[Line], is_last: bool) -> None:
    """The horizontal axis: the same for all panels, with its words under the last row of a scene."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator  # noqa: PLC0415 - slow

    if design.x is None:
        panel.set_xlim(-0.6, len(lines) - 0.4)
        turned = len(lines) > 4
        panel.set_xticks(range(len(lines)), [textwrap.fill(line.label, 24 if turned else 13) for line in lines])
        panel.tick_params(axis="x", labelbottom=is_last, rotation=35 if turned else 0)
        return
    places = places_of(lines, design.x)
    low, high = places[0], places[-1]
    if low > 0.0 and high / low > LOG_SPAN:
        panel.set_xscale("log")
        panel.set_xlim(low / (high / low) ** 0.06, high * (high / low) ** 0.06)
        gaps = [math.log(b / a) / math.log(high / low) for a, b in pairwise(places)]
    else:
        margin = 0.06 * (high - low) or 0.5 * abs(high) or 1.0
        panel.set_xlim(low - margin, high + margin)
        gaps = [(b - a) / (high - low) for a, b in pairwise(places)]
    if len(places) <= 9 and min(gaps, default=1.0) > 0.08:
        panel.xaxis.set_major_locator(FixedLocator(places))
        panel.xaxis.set_minor_locator(NullLocator())
        panel.xaxis.set_minor_formatter(NullFormatter())
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.tick_params(axis="x", labelbottom=is_last)
    if is_last:
        is_true, is_assumed = design.x == SCENE_RATIO, assumes_ratio(design)
        title = "true index ratio" if is_true else "assumed index ratio" if is_assumed else design.x
        panel.set_xlabel(title, fontsize=9)
