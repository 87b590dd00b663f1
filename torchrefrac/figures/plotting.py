"""Colours and axes that the figures of a report have in common; all colours differ for the colour-blind, too."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from torchrefrac.atomic import replacing

ESTIMATE, MEASURED, TRUE, SECOND = "#0072b2", "#e69f00", "#009e73", "#d55e00"  # Okabe and Ito's
GRID, TEXT, PALE = "#e4e6e8", "#444b52", "#b9d5e6"
WIDTH = 9.0
MOST_TICKS = 14
UNKNOWN = "-"


def blank_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Any:
    """A figure of this size in inches, without global state and without a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - slow to import
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(width, height), dpi=150, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Any, path: Path, **how: Any) -> None:
    """Write a figure, whole or not at all."""
    with replacing(path) as temporary:
        figure.savefig(temporary, **how)


def color_scale(low: float, high: float, colors: Any) -> Any:
    """Maps values from low to high to the colours of a colour map."""
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415 - slow to import
    from matplotlib.colors import Normalize  # noqa: PLC0415

    return ScalarMappable(Normalize(low, high), colors)


def color_bar(figure: Any, colored: Any, panels: list[Any], label: str) -> None:
    """Beside the panels, with what its numbers are."""
    fraction = 0.15 / len(panels)
    bar = figure.colorbar(colored, ax=panels, pad=0.01, aspect=30, fraction=fraction, extend="both", label=label)
    bar.ax.tick_params(labelsize=8)


def legend_key(**style: Any) -> Any:
    """A line or marker of a legend, with its `label`."""
    from matplotlib.lines import Line2D  # noqa: PLC0415 - slow to import

    return Line2D([], [], **style)


def panels(rows: int, columns: int, height: float, **how: Any) -> tuple[Any, Any]:
    """A figure with a grid of plain panels (always two-dimensional)."""
    figure = blank_figure(WIDTH, height)
    grid = figure.subplots(rows, columns, squeeze=False, **how)
    for panel in grid.flat:
        plain_axes(panel)
    return figure, grid


def plain_axes(panel: Any) -> None:
    """Light lines behind the data, and no frame but for the two axes."""
    panel.grid(color=GRID, lw=0.8)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color("#9aa1a8")
    panel.tick_params(labelsize=9, colors=TEXT)


def number_images(panel: Any, count: int) -> None:
    """The x axis counts images from 1, as the table of images does."""
    step = max(1, -(-count // MOST_TICKS))
    panel.set(xticks=range(1, count + 1, step), xlim=(0.3, count + 0.7), xlabel="image")


def height_colors() -> Any:
    """From dark for the lowest to light for the highest, without the end that is too pale for a white page."""
    from matplotlib import colormaps  # noqa: PLC0415 - slow to import
    from matplotlib.colors import ListedColormap  # noqa: PLC0415

    return ListedColormap([colormaps["viridis"](0.9 * step / 255.0) for step in range(256)], name="height")


def legend_above(figure: Any, handles: Sequence[Any]) -> None:
    """One line of keys above all panels, where there are any."""
    if handles:
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
