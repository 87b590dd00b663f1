"""summary.csv and the table of summary.md: one row a job."""

import csv
import io
from collections.abc import Callable, Sequence
from typing import NamedTuple

from torchrefrac.files.run import RunRecord, is_number
from torchrefrac.record.terminal import WIDTH
from torchrefrac.sweeps.cells import error_text, in_header, markdown_table, registered, rounded
from torchrefrac.sweeps.design import Design, scenes_of, short_keys
from torchrefrac.sweeps.figure import measures_of

ABOUT = ("job", "status", "reason", "scene", "model")
BRIEF = {"camera RMS": "camera", "3D error": "3D", "flatness": "flat", "dense error": "dense"}
NOTHING = "-"


class Column(NamedTuple):
    """A column of the table: names from long to short, and what a job has in it."""

    names: tuple[str, ...]
    cell: Callable[[RunRecord], str]


def csv_text(jobs: Sequence[RunRecord], design: Design) -> str:
    """Failed jobs first, then all others: what they are, what varied, and every metric that is a number, by name.

    A cell is empty where a job lacks the value.
    """
    names = {name for job in jobs for name, value in job.metrics.items() if is_number(value)}
    varied = [key for key in design.keys if key not in ABOUT]
    numbers = sorted(names - {*ABOUT, *varied})
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*ABOUT, *varied, *numbers])
    for job in sorted(jobs, key=lambda job: job.is_complete):
        about = [job.folder.name, job.status, job.reason, job.scene, job.model]
        settings = [job.overrides.get(key, "") for key in varied]
        metrics = [job.metrics[name] if is_number(job.metrics.get(name)) else "" for name in numbers]
        writer.writerow([*about, *settings, *metrics])
    return text.getvalue()


def results_table(jobs: Sequence[RunRecord], design: Design) -> str:
    """The complete jobs in Markdown, at most as wide as a terminal for usual sweeps; empty without such jobs.

    Names are shortened, and the last column is left out, where it does not fit otherwise.
    """
    complete = [job for job in jobs if job.is_complete]
    if not complete:
        return ""
    columns = _columns(complete, jobs, design)
    tables = [_render(chosen, complete, place) for chosen, place in ((columns, 0), (columns, -1), (columns[:-1], -1))]
    return next((table for table in tables if max(map(len, table.splitlines())) <= WIDTH), tables[-1])


def _columns(complete: Sequence[RunRecord], jobs: Sequence[RunRecord], design: Design) -> list[Column]:
    short = short_keys(design.keys)
    columns = []
    if len(scenes_of(complete)) > 1:
        columns.append(Column(("scene",), lambda job: job.scene or NOTHING))
    if len({job.model for job in jobs}) > 1 or not design.keys:
        columns.append(Column(("model",), lambda job: job.model or NOTHING))
    columns += [Column((short[key],), lambda job, key=key: job.overrides.get(key) or NOTHING) for key in design.keys]
    if len({tuple(column.cell(job) for column in columns) for job in complete}) < len(complete):
        columns.insert(0, Column(("job",), lambda job: job.folder.name))
    columns.append(Column(("registered", "reg."), registered))
    for measure in measures_of(complete):
        title, metric = measure.title.split(",")[0], measure.metric
        if measure.has_unit:
            names = tuple(in_header(name, complete, metric) for name in (title, BRIEF.get(title, title)))
            columns.append(Column(names, lambda job, metric=metric: error_text(job, complete, metric)))
        elif metric != "registered_share":
            columns.append(Column((title,), lambda job, metric=metric: _plain(job.number(metric))))
    if any(job.number("index_ratio_sigma") is not None for job in complete):
        columns.append(Column(("estimated ratio", "ratio"), _estimated))
    return [*columns, Column(("seconds", "s"), lambda job: rounded(job, "seconds_total", 1))]


def _render(columns: Sequence[Column], jobs: Sequence[RunRecord], place: int) -> str:
    rows = [[column.cell(job) for column in columns] for job in jobs]
    return markdown_table([column.names[place] for column in columns], rows)


def _plain(value: float | None) -> str:
    if value is None:
        return NOTHING
    return f"{value:.0f}" if value.is_integer() else f"{value:.3f}"


def _estimated(job: RunRecord) -> str:
    return NOTHING if job.number("index_ratio_sigma") is None else rounded(job, "index_ratio", 4)
