"""Several runs of one scene side by side: the paper's Table 1 and Figure 1."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrefrac.report.figures import TITLES, draw_side_views, side_view
from torchrefrac.report.metrics import evaluate
from torchrefrac.scene import Truth, load_cameras, load_points, load_truth
from torchrefrac.scene.atomic import replacing


def compare(runs: Sequence[Path], folder: Path) -> str:
    """Write table1.md and figure1.png of the run folders `runs` into `folder`; returns the table.

    Runs of several scenes share the table and get a figure each, figure1_SCENE.png.
    """
    metrics = [json.loads((run / "metrics.json").read_text(encoding="utf-8")) for run in runs]
    complete = [(run, m) for run, m in zip(runs, metrics, strict=True) if m["status"] == "complete"]
    scenes = list(dict.fromkeys(m["capture"] for _, m in complete))
    for scene in scenes:
        name = "figure1.png" if len(scenes) == 1 else f"figure1_{Path(scene).name}.png"
        _draw([(run, m) for run, m in complete if m["capture"] == scene], load_truth(Path(scene)), folder / name)
    table = _table(metrics, _labels(runs, metrics, len(scenes) > 1))
    with replacing(folder / "table1.md") as temporary:
        temporary.write_text(table + "\n", encoding="utf-8")
    return table


def _draw(runs: Sequence[tuple[Path, dict[str, Any]]], truth: Truth | None, path: Path) -> None:
    views = []
    for run, measured in runs:
        points, colors = load_points(run / "points.ply")
        reconstruction = replace(load_cameras(run / "cameras.json"), points=points, colors=colors)
        aligned = evaluate(reconstruction, truth)[1] if truth is not None else None
        views.append(side_view(measured["model"], reconstruction, aligned, measured))
    draw_side_views(views, truth, path)


def _labels(runs: Sequence[Path], metrics: Sequence[dict[str, Any]], several_scenes: bool) -> list[str]:
    """Model, with the scene where there are several, and with the run folder where that is not unique."""
    labels = [TITLES.get(m["model"], str(m["model"])) for m in metrics]
    if several_scenes:
        labels = [f"{Path(m.get('capture', '?')).name}: {label}" for m, label in zip(metrics, labels, strict=True)]
    if len(set(labels)) < len(labels):
        labels = [f"{label} [{run.name}]" for run, label in zip(runs, labels, strict=True)]
    return labels


def _table(metrics: Sequence[dict[str, Any]], labels: Sequence[str]) -> str:
    """One line a run, in Markdown that reads well in a terminal too.

    Camera RMS after alignment, median distance of the points from the true surface, median reprojection error.
    """
    unit = next((key.removeprefix("camera_rms_") for m in metrics for key in m if key.startswith("camera_rms_")), "")
    header = ["model", "images", "points", "error (px)", "seconds"]
    if unit:
        header[1:1] = [f"camera RMS ({unit})", f"off surface ({unit})"]
    rows = []
    for m, label in zip(metrics, labels, strict=True):
        row = [label]
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
