"""Panels of points side by side, in rows that look at them from different sides."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.figures.plotting import blank_figure, color_bar, color_scale, legend_above, legend_key, save
from torchrefrac.figures.side_views import (
    INK,
    PANEL_INCHES,
    camera_keys,
    draw_first_surface,
    outlines,
    side_direction,
)
from torchrefrac.scene.interfaces import SURFACE
from torchrefrac.scene.truth import Truth
from torchrefrac.scene.wording import OF_WATER, Wording

EMPTY, OUTLINE = "#d4d4d4", "#8c8c8c"
GOLDEN = 0.6180339887498949  # its multiples fill the interval from 0 to 1 evenly, modulo 1
TURN_DEG, RISE_DEG = 30.0, 28.0  # from where an oblique view looks: turned from the side, and raised
TO_FRONT_DEG = -55.0  # turned to where the cameras stand before a wall
SLIMMEST = 0.2  # a panel, its shorter side over its longer one


class Column(NamedTuple):
    """What both rows of a figure show of one reconstruction; values give the points their colour."""

    title: str
    caption: str
    points: Float[Tensor, "n 3"]
    values: Float[Tensor, " n"]
    length_unit: str
    centers: Float[Tensor, "m 3"] = torch.zeros(0, 3, dtype=torch.float64)
    has_water: bool = False
    words: Wording = OF_WATER

    @property
    def surface(self) -> str:
        """What the plane z = 0 is, where it is drawn."""
        return self.words.surface if self.has_water else ""


class Row(NamedTuple):
    """How one row of a figure looks at the scene.

    frame: rows right, up and towards the viewer; labels: of the axes, without them a bar shows the scale;
    has_cameras: whether cameras and the first surface are drawn; paper: colour behind the points.
    """

    frame: Float[Tensor, "3 3"]
    labels: tuple[str, str] | None
    has_cameras: bool
    paper: str


def draw_grid(
    columns: Sequence[Column],
    rows: Sequence[Row],
    truth: Truth | None,
    colors: tuple[Any, float, float, str],
    path: Path,
) -> None:
    """A grid of panels, a column a reconstruction, and a row a way to look at it; colours: map, ends, label."""
    name, low, high, label = colors
    limits = [_limits(columns, row, truth) for row in rows]
    ratios = [(y[1] - y[0]) / (x[1] - x[0]) for x, y in limits]
    lines = max(column.caption.count("\n") for column in columns) + 2
    labels = 0.55 * sum(row.labels is not None for row in rows) + 0.16 * lines
    figure = blank_figure(1.6 + PANEL_INCHES * len(columns), 0.75 + labels + PANEL_INCHES * sum(ratios))
    grid = figure.subplots(
        len(rows), len(columns), sharex="row", sharey="row", squeeze=False, gridspec_kw={"height_ratios": ratios}
    )
    colored = color_scale(low, high, name)
    for panels, row, (x, y) in zip(grid, rows, limits, strict=True):
        for panel, column in zip(panels, columns, strict=True):
            _draw_points(panel, column, row, colored, blur=0.01 * (x[1] - x[0]))
            _draw_surroundings(panel, column, row, truth)
            panel.set(xlim=x, ylim=y, aspect="equal", facecolor=row.paper)
            panel.tick_params(labelsize=8)
            if row.labels is None:
                scale_bar(panel, x, y, columns[0].length_unit)
            else:
                panel.set_xlabel(row.labels[0])
        if row.labels is not None:
            panels[0].set_ylabel(row.labels[1])
    for top, bottom, column in zip(grid[0], grid[-1], columns, strict=True):
        top.set_title(column.title, fontsize=13)
        bottom.set_xlabel(f"{bottom.get_xlabel()}\n{column.caption}")
    color_bar(figure, colored, list(grid.flat), label)
    surface = next((column.surface for column in columns if column.surface), "")
    handles = camera_keys(surface) if any(row.has_cameras for row in rows) else []
    if len(outlines(truth)):
        handles.append(legend_key(color=OUTLINE, lw=1.5, label="true planes"))
    legend_above(figure, handles)
    of_water = columns[0].words.kind == SURFACE
    save(figure, path, **({} if of_water else {"bbox_inches": "tight", "pad_inches": 0.1}))


def _draw_points(panel: Any, column: Column, row: Row, colored: Any, blur: float) -> None:
    """The farthest first, so that near ones hide them; each about as large as its share of the panel.

    Far within `blur` of each other their order is arbitrary: else, from above, the highest of a surface would win.
    """
    right, up, near = (column.points @ row.frame.mT).unbind(dim=-1)
    order = (near + blur * (GOLDEN * torch.arange(len(near), dtype=near.dtype)).frac()).argsort()
    size = min(max(2.5e5 / max(len(order), 1), 1.5), 7.0)
    panel.scatter(
        right[order].numpy(), up[order].numpy(), c=column.values[order].numpy(), norm=colored.norm, cmap=colored.cmap,
        s=size, linewidths=0, antialiased=False, rasterized=True, zorder=3,
    )  # fmt: skip


def _draw_surroundings(panel: Any, column: Column, row: Row, truth: Truth | None) -> None:
    """The outlines of the true planes, and the cameras and the first surface where the row has them."""
    for corners in outlines(truth):
        right, up, _ = (corners @ row.frame.mT).unbind(dim=-1)
        panel.plot(right.numpy(), up.numpy(), "-", color=OUTLINE, lw=1.5, zorder=1)
    if row.has_cameras:
        right, up, _ = (column.centers @ row.frame.mT).unbind(dim=-1)
        panel.plot(right.numpy(), up.numpy(), "^", ms=5, mfc="none", mec=INK, zorder=4)
        if column.surface:
            draw_first_surface(panel, column.words)


def scale_bar(panel: Any, x: Sequence[float], y: Sequence[float], unit: str) -> None:
    """In place of axes, as an oblique view has none: a length that holds for whatever lies across the view."""
    width, height = x[1] - x[0], y[1] - y[0]
    length = rounded_up(0.1 * width)
    start, level = x[0] + 0.04 * width, y[0] + 0.05 * height
    panel.plot((start, start + length), (level, level), "-", color=INK, lw=2.0, zorder=5)
    panel.text(start + 0.5 * length, level + 0.015 * height, f"{length:g} {unit}", ha="center", va="bottom", fontsize=9)
    panel.set(xticks=[], yticks=[])


def _limits(columns: Sequence[Column], row: Row, truth: Truth | None) -> list[list[float]]:
    """Horizontal and vertical range of a row: true planes, all but stray points, and what else the row has."""
    shown = [outlines(truth).flatten(0, 1) @ row.frame.mT]
    for column in columns:
        points = column.points @ row.frame.mT
        if len(points):
            shown.append(points.quantile(torch.tensor((0.001, 0.999), dtype=points.dtype), dim=0))
        if row.has_cameras:
            shown.append(column.centers @ row.frame.mT)
            if column.words.surface:
                shown.append(torch.zeros(1, 3, dtype=torch.float64))
    every = torch.cat(shown)[:, :2]
    every = every if len(every) else torch.zeros(1, 2, dtype=torch.float64)
    low, high = every.amin(dim=0), every.amax(dim=0)
    half = 0.56 * (high - low)
    half = half.clamp(min=SLIMMEST * float(half.max())) if half.max() > 0.0 else torch.ones_like(half)
    return torch.stack((0.5 * (low + high) - half, 0.5 * (low + high) + half), dim=-1).tolist()


def oblique(side: Float[Tensor, "3 3"], turn_deg: float = TURN_DEG, rise_deg: float = RISE_DEG) -> Float[Tensor, "3 3"]:
    """The frame of an oblique view: that from the side, turned about the vertical and raised."""
    turn, rise = math.radians(turn_deg), math.radians(rise_deg)
    right = math.cos(turn) * side[0] + math.sin(turn) * side[2]
    level = math.cos(turn) * side[2] - math.sin(turn) * side[0]
    return torch.stack(
        (right, math.cos(rise) * side[1] - math.sin(rise) * level, math.sin(rise) * side[1] + math.cos(rise) * level)
    )


def from_side(truth: Truth | None, words: Wording = OF_WATER) -> Float[Tensor, "3 3"]:
    """Frame that looks along the horizontal direction in which the true planes are thinnest; along a wall, z to the
    right and y upwards."""
    if words.is_wall:
        return torch.tensor(((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)), dtype=torch.float64)
    x, y = side_direction(truth).tolist()
    return torch.tensor(((x, y, 0.0), (0.0, 0.0, 1.0), (y, -x, 0.0)), dtype=torch.float64)


def rounded_up(value: float) -> float:
    """1, 2, 5 or 10 times a power of ten; 1 for 0."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power * (1.0 + 1e-9))
