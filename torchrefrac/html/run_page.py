"""The report of one run."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrefrac.figures.residuals import Residuals
from torchrefrac.files.run import REPORT, RunRecord
from torchrefrac.html import drawn, words
from torchrefrac.html.contents import RunContents, read_contents
from torchrefrac.html.page import write_page
from torchrefrac.html.scene_page import write_scene_page
from torchrefrac.html.survey import compared_table, level_table, methods, order_table, survey_facts
from torchrefrac.html.tables import (
    Entry,
    cameras,
    file_link,
    files_of,
    photograph_columns,
    photographs,
    table1,
    timings,
)
from torchrefrac.record.summary import dense_lines
from torchrefrac.scene import Truth
from torchrefrac.sweeps.design import MOST_PANELS

LOG, LOG_LINES = "run.log", 60


def write_report(run: Path, compared: Sequence[Path] = ()) -> Path:
    """Write `run`/report.html from what lies in the run folder, however far the run got; returns its path. Beside it,
    where there are cameras, scene.html shows them and the points in three dimensions.

    compared: runs of the same photographs with other models, which stand beside it in Table 1 and Figure 1. The page
    needs no other file and no network; links to files of the run are relative. What cannot be read is left out, and the
    page says so. Raises OSError where a page cannot be written.
    """
    truths: dict[Path, Truth | None] = {}
    contents = read_contents(run, truths)
    record, scene = contents.record, contents.scene
    beside = [other for other in compared if other.resolve() != run.resolve()]
    others = [read_contents(other, truths, with_capture=False) for other in beside]
    residuals = Residuals.of(scene) if scene is not None and len(scene.observations) else None
    residuals = residuals if residuals is not None and len(residuals) else None
    scene_page = write_scene_page(contents)
    write_page(
        "run.html",
        run / REPORT,
        title=words.job_name(record),
        run=contents,
        record=record,
        sizes=words.sizes(contents.capture) if contents.capture is not None else "",
        model_words=words.model_words(record.model, contents.words),
        interfaces=words.interfaces(contents.capture),
        wording=contents.words,
        upright=words.upright(record),
        verdict=words.verdict(record, contents.unit),
        tiles=_tiles(contents),
        scene_page=None if scene_page is None else file_link(scene_page),
        table=_table(contents, others) if record.is_complete else None,
        figures=_figures(contents, others, residuals),
        dense=drawn.draw_dense(run, contents.words, contents.own_words) if "dense_points" in record.metrics else [],
        dense_words=_dense_words(record.metrics),
        survey=survey_facts(contents),
        orders=order_table(contents),
        levels=level_table(contents),
        control=compared_table(contents, "control"),
        check=compared_table(contents, "check"),
        methods=methods(contents),
        determined=_determined(record.metrics),
        held=list((record.metrics.get("held") or {}).values()),
        cameras=cameras(contents),
        positions=words.positions(contents.capture, record),
        columns=photograph_columns(contents),
        photographs=photographs(contents, residuals),
        timings=timings(record),
        total=words.seconds(record.number("seconds_total") or 0.0),
        memory=record.metrics.get("peak_memory_gib"),
        files=files_of(run),
        log=_tail(run / LOG),
    )
    return run / REPORT


def _tiles(run: RunContents) -> list[tuple[str, str]]:
    """The few numbers that matter, with what they are."""
    m, unit = run.record.metrics, run.unit
    found: list[tuple[str, str]] = []
    if words.placed_words(m) != words.UNKNOWN:
        found.append((words.placed_words(m, " / "), "photographs placed"))
    for key, what in (("camera_rms", "camera error, RMS"), ("point_median", "3D error of the points, median")):
        if m.get(f"{key}_{unit}") is not None:
            found.append((f"{words.rounded(m[f'{key}_{unit}'])} {unit}", what))
    if m.get(f"point_median_{unit}") is None and m.get(f"surface_median_{unit}") is not None:
        found.append((f"{words.rounded(m[f'surface_median_{unit}'])} {unit}", "points off the true surface, median"))
    if m.get("reprojection_median_px") is not None:
        found.append((f"{words.rounded(m['reprojection_median_px'])} px", "reprojection error, median"))
    if run.record.model == "refractive" and m.get("index_ratio") is not None:
        sigma, true = m.get("index_ratio_sigma"), m.get("true_index_ratio")
        what = "index ratio, " + ("assumed" if sigma is None else "estimated")
        value = words.with_sigma(m["index_ratio"], sigma)
        found.append((value, what + (f" (true {words.plain(true)})" if true is not None else "")))
    if "points" in m:
        outside = m.get("points_outside_water")
        what = f"points, {words.counted(outside)} of them outside the water" if outside else "points"
        found.append((words.counted(m["points"]), what))
    if found and "seconds_total" in m:
        found.append((words.seconds(float(m["seconds_total"])), "time"))
    return found


def _table(run: RunContents, others: Sequence[RunContents]) -> Any:
    every = _in_order([run, *others])
    titles = _titles(every)
    entries = [
        Entry(title, each.record, "" if each is run else relative_report(each.record.folder, run.record.folder))
        for title, each in zip(titles, every, strict=True)
    ]
    return table1(entries, run.unit, every.index(run) if others else None)


def _figures(run: RunContents, others: Sequence[RunContents], residuals: Residuals | None) -> list[drawn.Drawn]:
    shown = run.shown
    if shown is None or not bool(shown.views.registered.any()):
        return []
    every, of_kind = _in_order([run, *others]), run.words
    beside = every if len(every) <= MOST_PANELS else [run]
    path = drawn.draw_cameras(shown, run.truth, of_kind)
    found = [drawn.draw_models(beside, _titles(beside)), path, drawn.draw_attitude(run)]
    if residuals is not None and run.scene is not None:
        found += drawn.draw_residuals(residuals, run.scene, of_kind)
    found += [drawn.draw_shift(run), drawn.draw_uncertainty(shown, run.truth, of_kind)]
    return [figure for figure in found if figure is not None]


def _in_order(runs: Sequence[RunContents]) -> list[RunContents]:
    return sorted(runs, key=lambda run: words.model_order(run.record))


def _titles(runs: Sequence[RunContents]) -> list[str]:
    """What each is called: its model, with the folder where that is not enough."""
    return words.distinct([words.model_title(run.record.model) for run in runs], [run.record for run in runs])


def relative_report(run: Path, folder: Path) -> str:
    """Where the report of `run` is, from a page in `folder`."""
    return Path(os.path.relpath(run.resolve() / REPORT, folder.resolve())).as_posix()


def report_link(record: RunRecord, folder: Path) -> str:
    """The same of a run that may have none, for which it is empty."""
    return relative_report(record.folder, folder) if (record.folder / REPORT).is_file() else ""


def _determined(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The verdicts of the adjustment as what and how well."""
    pairs = [str(sentence).partition(": ") for sentence in metrics.get("determined") or []]
    return [(name, how_well or words.UNKNOWN) for name, _, how_well in pairs]


def _dense_words(metrics: Mapping[str, Any]) -> list[str]:
    """Empty where a metric is missing, as after a dense stage that did not finish."""
    try:
        return dense_lines(metrics) if "dense_points" in metrics else []
    except KeyError:
        return []


def _tail(path: Path) -> str:
    """The end of the log; empty where there is none."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    return "\n".join(lines[-LOG_LINES:])
