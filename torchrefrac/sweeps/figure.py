"""summary.png: what was varied along the axis, a row a kind of error, a column a scene, a line a model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrefrac.figures.plotting import blank_figure, save
from torchrefrac.figures.side_views import INK
from torchrefrac.files.run import RunRecord
from torchrefrac.sweeps.cells import unit_of
from torchrefrac.sweeps.design import Design, scenes_of
from torchrefrac.sweeps.drawing import draw_spots, draw_true_ratio, legend_handles, set_heights, set_places
from torchrefrac.sweeps.lines import Line, Spot, lines_of, places_of, spots_of

AGAINST_TRUTH = (
    (("camera_rms",), "camera RMS"),
    (("point_median", "surface_median"), "3D error, median"),
    (("flatness",), "flatness, RMS"),
    (("dense_surface_median",), "dense error, median"),
)
WITHOUT_TRUTH = (
    ("reprojection_median_px", "error (px), median"),
    ("registered_share", "registered (%)"),
    ("points", "points"),
)
WIDEST = 4  # scenes side by side
PANEL_WIDTHS, PANEL_HEIGHT = (5.6, 4.2, 3.6, 3.2), 2.3  # inches, by the number of columns
FEW_DOTS, LOW_HEIGHT = 4, 1.5  # on an axis of names, and of a panel that has no more of them


@dataclass(frozen=True)
class Measure:
    """One row: a metric, without its unit where it has one, and what the axis says."""

    metric: str
    title: str
    has_unit: bool


@dataclass(frozen=True)
class Cell:
    """One panel: what a scene has of a measure, a list of spots for each line."""

    unit: str
    spots: list[list[Spot]]

    @property
    def values(self) -> list[float]:
        """All that is drawn."""
        return [value for spots in self.spots for spot in spots for value in spot.values]


def draw_sweep(jobs: Sequence[RunRecord], design: Design, path: Path) -> bool:
    """Write the figure; returns False, and writes none, where no job is complete.

    Scenes of which no job is complete are left out. Rows are the errors against truth that the jobs have, else what can
    be known without it.
    """
    complete = [job for job in jobs if job.is_complete]
    measures, scenes, lines = measures_of(complete), scenes_of(complete), lines_of(jobs, design)
    if not measures:
        return False
    blocks = math.ceil(len(scenes) / WIDEST)
    columns = math.ceil(len(scenes) / blocks)
    width = PANEL_WIDTHS[columns - 1] * columns
    handles = legend_handles(jobs, design, lines)
    longest = max((len(handle.get_label()) for handle in handles), default=0)
    per_row = max(1, int((width + 0.7) / (0.45 + 0.065 * longest)))
    legend = 0.22 * math.ceil(len(handles) / per_row) + 0.5
    is_low = design.x is None and len(lines) <= FEW_DOTS
    height = LOW_HEIGHT if is_low else PANEL_HEIGHT
    figure = blank_figure(width + 0.7, blocks * (height * len(measures) + 0.4) + legend)
    grid = figure.subplots(blocks * len(measures), columns, squeeze=False)
    # A job of which nothing is known may belong anywhere: each line is broken where it lacks a place of the others.
    is_torn = design.x is not None and any(not (job.overrides or job.is_complete) for job in jobs)
    expected = places_of(lines, design.x) if is_torn and design.x is not None else []
    for row, measure in enumerate(measures):
        cells = [_cell(measure, complete, lines, scene, design, expected) for scene in scenes]
        for i in range(blocks * columns):
            block, column = divmod(i, columns)
            panel = grid[block * len(measures) + row][column]
            if i >= len(cells):
                panel.set_visible(False)
                continue
            _draw_cell(panel, cells[i], lines, design)
            set_heights(panel, [value for cell in cells if cell.unit == cells[i].unit for value in cell.values])
            if column and cells[i].unit == cells[i - column].unit:
                panel.tick_params(labelleft=False)
            else:
                unit = f" ({cells[i].unit})" if measure.has_unit and cells[i].unit else ""
                title = measure.title.replace(", ", ",\n") if is_low else measure.title
                panel.set_ylabel(f"{title}{unit}", fontsize=9)
            if row == 0:
                panel.set_title(scenes[i], fontsize=11)
            set_places(panel, design, lines, is_last=row == len(measures) - 1)
            draw_true_ratio(panel, [job for job in complete if job.scene == scenes[i]], design)
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=per_row, fontsize=8.5, frameon=False)
    save(figure, path)
    return True


def measures_of(jobs: Sequence[RunRecord]) -> list[Measure]:
    """The rows of the figure; empty without complete jobs."""
    known = ((next((stem for stem in stems if unit_of(jobs, stem)), ""), title) for stems, title in AGAINST_TRUTH)
    found = [Measure(stem, title, True) for stem, title in known if stem]
    return found if found or not jobs else [Measure(name, title, False) for name, title in WITHOUT_TRUTH]


def _cell(
    measure: Measure,
    complete: Sequence[RunRecord],
    lines: Sequence[Line],
    scene: str,
    design: Design,
    expected: Sequence[float],
) -> Cell:
    unit = unit_of([job for job in complete if job.scene == scene], measure.metric) if measure.has_unit else ""
    name = f"{measure.metric}_{unit}" if measure.has_unit else measure.metric
    return Cell(unit, [spots_of(line, scene, design.x, name, i, expected) for i, line in enumerate(lines)])


def _draw_cell(panel: Any, cell: Cell, lines: Sequence[Line], design: Design) -> None:
    """Failures at one place stand above each other."""
    height: dict[float, int] = {}
    for spots, line in zip(cell.spots, lines, strict=True):
        draw_spots(panel, spots, line, design, len(lines))
        for spot in spots:
            if spot.failures:
                level = height.setdefault(spot.x, 0)
                height[spot.x] += 1
                panel.plot(
                    spot.x, 0.05 + 0.07 * level, "x", ms=6, mew=1.6, color=line.color, clip_on=False, zorder=5,
                    transform=panel.get_xaxis_transform(),
                )  # fmt: skip
    panel.grid(True, color="#e6e6e6", lw=0.6, zorder=0)
    panel.tick_params(labelsize=8)
    panel.spines[["top", "right"]].set_visible(False)
    if not cell.values:
        panel.text(0.5, 0.5, "no value", transform=panel.transAxes, ha="center", va="center", color=INK, fontsize=9)
