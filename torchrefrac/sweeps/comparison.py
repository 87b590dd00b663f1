"""Several runs of one scene side by side: the paper's Table 1 and Figure 1, and the same of dense surfaces."""

from collections.abc import Sequence
from pathlib import Path

from torchrefrac.atomic import replacing
from torchrefrac.evaluate.dense_metrics import FOUND, TYPICAL
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.figures.dense import dense_view, draw_dense_views, draw_error_map, error_panel
from torchrefrac.figures.side_views import TITLES, draw_side_views, side_view
from torchrefrac.files.cameras import CAMERAS, load_points, read_cameras
from torchrefrac.files.dense import load_dense
from torchrefrac.files.run import DENSE_CLOUD, RunRecord
from torchrefrac.files.truth import load_truth
from torchrefrac.scene.wording import wording_of
from torchrefrac.sweeps.cells import decimals, error_text, in_header, markdown_table, registered, rounded, unit_of
from torchrefrac.sweeps.design import FIGURES, has_paper_form, load_runs, scenes_of, shown_together, what_varied

POINTS = "points.ply"


def compare(runs: Sequence[Path], folder: Path) -> str:
    """Write table1.md and figure1.png of the run folders `runs` into `folder`; returns the table, failed runs first.

    Where runs are dense, also dense_figure1.png, and dense_error_map.png where the truth has planes. Runs of several
    scenes share the table and get figures of their own, figure1_SCENE.png and so on. A run without a readable
    metrics.json counts as failed.

    Runs that differ in more than scene, model and dense method have a figure for each scene and combination of the
    other values, figure1_SCENE_VALUE.png, where 2 to 6 runs share these. There is no table of theirs: the text returned
    is empty, and a table1.md that an earlier sweep left is removed. See `sweep.write_summary`.
    """
    jobs = load_runs(runs)
    design = what_varied(jobs)
    for end, shown in shown_together(jobs, design).items():
        there = [job for job in shown if all((job.folder / name).is_file() for name in (CAMERAS, POINTS))]
        if there:
            _draw(there, *(folder / f"{kind}{end}" for kind in FIGURES))
    if not has_paper_form(design):
        (folder / "table1.md").unlink(missing_ok=True)
        return ""
    jobs.sort(key=lambda job: job.is_complete)
    labels = _labels(jobs)
    table = _table(jobs, labels)
    dense = [(job, label) for job, label in zip(jobs, labels, strict=True) if "dense_points" in job.metrics]
    if dense:
        table += "\n\n" + _dense_table(dense)
    with replacing(folder / "table1.md") as temporary:
        temporary.write_text(table + "\n", encoding="utf-8")
    return table


def _draw(jobs: Sequence[RunRecord], sides_path: Path, dense_path: Path, map_path: Path) -> None:
    """The figures of jobs with one capture."""
    truth = load_truth(jobs[0].capture) if jobs[0].capture is not None else None
    views, dense, panels = [], [], []
    for job, title in zip(jobs, _distinct(_names(jobs), jobs), strict=True):
        scene = read_cameras(job.folder / CAMERAS).with_points(*load_points(job.folder / POINTS))
        aligned = evaluate(scene, truth)[1] if truth is not None else None
        views.append(side_view(title, scene, aligned, job.metrics))
        if "dense_points" in job.metrics and (job.folder / DENSE_CLOUD).is_file():
            cloud = load_dense(job.folder / DENSE_CLOUD)
            dense.append(dense_view(title, cloud, scene, aligned, job.metrics))
            if truth is not None and aligned is not None and len(truth.corner):
                words = wording_of(scene, job.metrics, upright=True)
                panels.append(error_panel(title, cloud, aligned, truth, job.metrics, words))
    draw_side_views(views, truth, sides_path)
    if dense:
        draw_dense_views(dense, truth, dense_path)
    if truth is not None and panels:
        draw_error_map(panels, truth, map_path)


def _labels(jobs: Sequence[RunRecord]) -> list[str]:
    """What the rows of a table are called: the model, as in `_names`, after the scene where there are several."""
    labels = _names(jobs)
    if len(scenes_of(job for job in jobs if job.is_complete)) > 1:
        labels = [f"{job.scene or '?'}: {label}" for job, label in zip(jobs, labels, strict=True)]
    return _distinct(labels, jobs)


def _names(jobs: Sequence[RunRecord]) -> list[str]:
    """Model, with the dense method where there are several."""
    names = [TITLES.get(job.model, job.model or "unknown") for job in jobs]
    methods = [job.metrics.get("dense_method") for job in jobs]
    if len(set(methods)) == 1:
        return names
    return [name + (f", {method}" if method else "") for method, name in zip(methods, names, strict=True)]


def _distinct(words: list[str], jobs: Sequence[RunRecord]) -> list[str]:
    """The same words, with the run folder where that is not unique."""
    if len(set(words)) == len(words):
        return words
    return [f"{word} [{job.folder.name}]" for word, job in zip(words, jobs, strict=True)]


def _table(jobs: Sequence[RunRecord], labels: Sequence[str]) -> str:
    """One line a run, in Markdown that reads well in a terminal too.

    Camera RMS after alignment, median distance of the points from their true places (where only the surface is known,
    from that), median reprojection error.
    """
    points = ("3D error", "point_median") if unit_of(jobs, "point_median") else ("off surface", "surface_median")
    errors = dict((("camera RMS", "camera_rms"), points)) if unit_of(jobs, "camera_rms") else {}
    header = ["model", *(in_header(title, jobs, stem) for title, stem in errors.items())]
    header += ["images", "points", "error (px)", "seconds"]
    rows = []
    for job, label in zip(jobs, labels, strict=True):
        cells = [error_text(job, jobs, stem) for stem in errors.values()]
        cells += [registered(job), rounded(job, "points")]
        cells += [rounded(job, "reprojection_median_px", 3), rounded(job, "seconds_total", 1)]
        rows.append([label, *(cells if job.is_complete else [job.status, *[""] * (len(cells) - 1)])])
    return markdown_table(header, rows)


def _dense_table(jobs: Sequence[tuple[RunRecord, str]]) -> str:
    """The same of dense surfaces.

    Share of the points that lie near the true surface, share of the textured true surface that has points near it
    (found), RMS distance of the inliers from the true planes.
    """
    unit = unit_of((job for job, _ in jobs), "dense_surface_median")
    near, found = (f"within_{limit:g}_{unit}" for limit in (TYPICAL, FOUND))
    header = ["dense", "points", "patches/s", "seconds"]
    if unit:
        header[2:2] = [f"within {TYPICAL:g} {unit}", "found", f"RMS ({unit})"]
    rows = []
    for job, label in jobs:
        row = [label, rounded(job, "dense_points")]
        if unit:
            row += [_percent(job.number(f"dense_accuracy_{near}")), _percent(job.number(f"dense_completeness_{found}"))]
            row.append(decimals(job.number(f"dense_plane_rms_{unit}")))
        rows.append([*row, rounded(job, "dense_patches_per_s", 0), rounded(job, "seconds_dense", 1)])
    return markdown_table(header, rows)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f} %"
