"""The axes of the panels of a sweep's figure: scales, ends and ticks."""

import math
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from torchrefrac.sweeps.design import Design
from torchrefrac.sweeps.lines import Line, places_of

LOG_SPAN = 30.0  # a range of more than this is drawn on a logarithmic scale


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
        panel.set_xlabel(axis_title(design.x), fontsize=9)


def axis_title(key: str) -> str:
    """What the horizontal axis says of the key along it."""
    if key == "scene.index_ratio":
        return "true index ratio"
    return "assumed index ratio" if key.endswith("index_ratio") else key
