"""Several runs of one scene side by side: the paper's Table 1 and Figure 1."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrefrac.report.figures import TITLES, draw_side_views, side_view
from torchrefrac.report.metrics import evaluate
from torchrefrac.scene import Truth, load_cameras, load_points
from torchrefrac.scene.atomic import replacing


def compare(runs: Sequence[Path], truth: Truth | None, folder: Path) -> str:
    """Write table1.md and figure1.png of the run folders `runs` into `folder`; returns the table."""
    metrics = [json.loads((run / "metrics.json").read_text(encoding="utf-8")) for run in runs]
    table = _table(metrics)
    with replacing(folder / "table1.md") as temporary:
        temporary.write_text(table + "\n", encoding="utf-8")
    views = []
    for run, measured in zip(runs, metrics, strict=True):
        if measured["status"] != "complete":
            continue
        points, colors = load_points(run / "points.ply")
        reconstruction = replace(load_cameras(run / "cameras.json"), points=points, colors=colors)
        aligned = evaluate(reconstruction, truth)[1] if truth is not None else None
        views.append(side_view(measured["model"], reconstruction, aligned, measured))
    if views:
        draw_side_views(views, truth, folder / "figure1.png")
    return table


def _table(metrics: Sequence[dict[str, Any]]) -> str:
    """One line a run, in Markdown that reads well in a terminal too.

    Camera RMS after alignment, median distance of the points from the true surface, median reprojection error.
    """
    unit = next((key.removeprefix("camera_rms_") for m in metrics for key in m if key.startswith("camera_rms_")), "")
    header = ["model", "images", "points", "error (px)", "seconds"]
    if unit:
        header[1:1] = [f"camera RMS ({unit})", f"off surface ({unit})"]
    rows = []
    for m in metrics:
        row = [TITLES.get(m["model"], m["model"])]
        if m["status"] != "complete":
            rows.append([*row, m["status"], *[""] * (len(header) - 2)])
            continue
        if unit:
            row += [_number(m.get(f"camera_rms_{unit}")), _number(m.get(f"surface_median_{unit}"))]
        row += [f"{m['registered_images']}/{m['images']}", str(m["points"])]
        row += [f"{m['reprojection_median_px']:.3f}", f"{m['seconds_total']:.1f}"]
        rows.append(row)
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    lines = [_line(header, widths), "|" + "|".join("-" * (w + 2) for w in widths) + "|"]
    return "\n".join(lines + [_line(row, widths) for row in rows])


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
