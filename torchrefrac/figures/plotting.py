"""Colours and axes that the figures of a report have in common; all colours differ for the colour-blind, too."""

import math
from collections.abc import Sequence
from typing import Any

from torchrefrac.figures.panels import blank_figure

ESTIMATE, MEASURED, TRUE, SECOND = "#0072b2", "#e69f00", "#009e73", "#d55e00"  # Okabe and Ito's
GRID, TEXT, PALE = "#e4e6e8", "#444b52", "#b9d5e6"
WIDTH = 9.0
MOST_TICKS = 14
UNKNOWN = "-"


def panels(rows: int, columns: int, height: float, width: float = WIDTH, **how: Any) -> tuple[Any, Any]:
    """A figure with a grid of plain panels (always two-dimensional)."""
    figure = blank_figure(width, height)
    grid = figure.subplots(rows, columns, squeeze=False, **how)
    for panel in grid.flat:
        plain_axes(panel)
    return figure, grid


def plain_axes(panel: Any) -> None:
    """Light lines behind the data, and no frame but for the two axes."""
    panel.grid(color=GRID, lw=0.8)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        panel.spines[side].set_color("#9aa1a8")
    panel.tick_params(labelsize=9, colors=TEXT)


def number_images(panel: Any, count: int, label: bool = True) -> None:
    """The x axis counts images from 1, as the table of images does."""
    step = max(1, -(-count // MOST_TICKS))
    panel.set_xticks(range(1, count + 1, step))
    panel.set_xlim(0.3, count + 0.7)
    if label:
        panel.set_xlabel("image", fontsize=10)


def height_colors() -> Any:
    """From dark for the lowest to light for the highest, without the end that is too pale for a white page."""
    from matplotlib import colormaps  # noqa: PLC0415 - slow to import
    from matplotlib.colors import ListedColormap  # noqa: PLC0415

    return ListedColormap([colormaps["viridis"](0.9 * step / 255.0) for step in range(256)], name="height")


def legend_above(figure: Any, handles: Sequence[Any]) -> None:
    """One line of keys above all panels."""
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=9, frameon=False)


def rounded(value: float | None, digits: int = 2) -> str:
    """To so many significant digits, without an exponent where the number is of ordinary size; a dash for None."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0.0:
        return "0"
    power = math.floor(math.log10(abs(value)))
    if not -5 <= power < 7:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - power)}f}"
