"""Several runs of one scene side by side: the paper's Table 1 and Figure 1, and the same of dense surfaces."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrefrac.geometry import Similarity
from torchrefrac.report.dense_figures import dense_view, draw_dense_views, draw_error_map, error_panel
from torchrefrac.report.dense_metrics import FOUND, TYPICAL
from torchrefrac.report.dense_outputs import DENSE_CLOUD
from torchrefrac.report.figures import TITLES, draw_side_views, side_view
from torchrefrac.report.metrics import evaluate
from torchrefrac.scene import Reconstruction, Truth, load_cameras, load_dense, load_points, load_truth
from torchrefrac.scene.atomic import replacing


def compare(runs: Sequence[Path], folder: Path) -> str:
    """Write table1.md and figure1.png of the run folders `runs` into `folder`; returns the table.

    Where runs are dense, also dense_figure1.png, and dense_error_map.png where the truth has planes. Runs of several
    scenes share the table and get figures of their own, figure1_SCENE.png and so on.
    """
    metrics = [json.loads((run / "metrics.json").read_text(encoding="utf-8")) for run in runs]
    complete = [(run, m) for run, m in zip(runs, metrics, strict=True) if m["status"] == "complete"]
    scenes = list(dict.fromkeys(m["capture"] for _, m in complete))
    for scene in scenes:
        end = ".png" if len(scenes) == 1 else f"_{Path(scene).name}.png"
        _draw([(run, m) for run, m in complete if m["capture"] == scene], load_truth(Path(scene)), folder, end)
    labels = _labels(runs, metrics, len(scenes) > 1)
    table = _table(metrics, labels)
    dense = [(m, label) for m, label in zip(metrics, labels, strict=True) if "dense_points" in m]
    if dense:
        table += "\n\n" + _dense_table(dense)
    with replacing(folder / "table1.md") as temporary:
        temporary.write_text(table + "\n", encoding="utf-8")
    return table


def _draw(runs: Sequence[tuple[Path, dict[str, Any]]], truth: Truth | None, folder: Path, end: str) -> None:
    views, dense = [], []
    for run, measured in runs:
        points, colors = load_points(run / "points.ply")
        reconstruction = replace(load_cameras(run / "cameras.json"), points=points, colors=colors)
        aligned = evaluate(reconstruction, truth)[1] if truth is not None else None
        views.append(side_view(measured["model"], reconstruction, aligned, measured))
        if "dense_points" in measured and (run / DENSE_CLOUD).is_file():
            dense.append((run, measured, reconstruction, aligned))
    draw_side_views(views, truth, folder / f"figure1{end}")
    if dense:
        _draw_dense(dense, truth, folder, end)


def _draw_dense(
    runs: Sequence[tuple[Path, dict[str, Any], Reconstruction, Similarity | None]],
    truth: Truth | None,
    folder: Path,
    end: str,
) -> None:
    views, panels = [], []
    for run, measured, reconstruction, aligned in runs:
        cloud = load_dense(run / DENSE_CLOUD)
        views.append(dense_view(measured["model"], cloud, reconstruction, aligned, measured))
        if truth is not None and aligned is not None and len(truth.corner):
            panels.append(error_panel(measured["model"], cloud, aligned, truth, measured))
    draw_dense_views(views, truth, folder / f"dense_figure1{end}")
    if truth is not None and panels:
        draw_error_map(panels, truth, folder / f"dense_error_map{end}")


def _labels(runs: Sequence[Path], metrics: Sequence[dict[str, Any]], several_scenes: bool) -> list[str]:
    """Model, with the scene and the dense method where there are several, and with the run folder where that is not
    unique."""
    labels = [TITLES.get(m["model"], str(m["model"])) for m in metrics]
    if several_scenes:
        labels = [f"{Path(m.get('capture', '?')).name}: {label}" for m, label in zip(metrics, labels, strict=True)]
    methods = [m.get("dense_method") for m in metrics]
    if len(set(methods)) > 1:
        labels = [label + (f", {method}" if method else "") for method, label in zip(methods, labels, strict=True)]
    if len(set(labels)) < len(labels):
        labels = [f"{label} [{run.name}]" for run, label in zip(runs, labels, strict=True)]
    return labels


def _table(metrics: Sequence[dict[str, Any]], labels: Sequence[str]) -> str:
    """One line a run, in Markdown that reads well in a terminal too.

    Camera RMS after alignment, median distance of the points from the true surface, median reprojection error.
    """
    unit = _unit(metrics, "camera_rms_")
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
    return _markdown(header, rows)


def _dense_table(runs: Sequence[tuple[dict[str, Any], str]]) -> str:
    """The same of dense surfaces.

    Share of the points that lie near the true surface, share of the textured true surface that has points near it
    (found), RMS distance of the inliers from the true planes.
    """
    unit = _unit([m for m, _ in runs], "dense_surface_median_")
    near, found = (f"within_{limit:g}_{unit}" for limit in (TYPICAL, FOUND))
    header = ["dense", "points", "patches/s", "seconds"]
    if unit:
        header[2:2] = [f"within {TYPICAL:g} {unit}", "found", f"RMS ({unit})"]
    rows = []
    for m, label in runs:
        row = [label, str(m["dense_points"])]
        if unit:
            row += [_percent(m.get(f"dense_accuracy_{near}")), _percent(m.get(f"dense_completeness_{found}"))]
            row.append(_number(m.get(f"dense_plane_rms_{unit}")))
        rows.append([*row, f"{m.get('dense_patches_per_s', 0.0):.0f}", f"{m.get('seconds_dense', 0.0):.1f}"])
    return _markdown(header, rows)


def _unit(metrics: Sequence[dict[str, Any]], start: str) -> str:
    """The unit that ends the name of a metric; empty where no run has it."""
    return next((key.removeprefix(start) for m in metrics for key in m if key.startswith(start)), "")


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    lines = [_line(header, widths), "|" + "|".join("-" * (w + 2) for w in widths) + "|"]
    return "\n".join(lines + [_line(row, widths) for row in rows])


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f} %"
