"""summary.csv and the table of summary.md: one row a job."""

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torchrefrac.files.run import RunRecord, is_number
from torchrefrac.record.terminal import WIDTH
from torchrefrac.sweeps.design import Design, failed_first, scenes_of, short_keys
from torchrefrac.sweeps.figure import measures_of
from torchrefrac.sweeps.markdown import markdown_table
from torchrefrac.sweeps.units import error_text, in_header, registered, rounded

ABOUT = ("job", "status", "reason", "scene", "model")
BRIEF = {"camera RMS": "camera", "3D error": "3D", "flatness": "flat", "dense error": "dense"}
NOTHING = "-"


@dataclass(frozen=True)
class Column:
    """A column of the table: names from long to short, what a job has in it; is_extra: may go where width is short."""

    names: tuple[str, ...]
    cell: Callable[[RunRecord], str]
    is_extra: bool = False


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
    for job in failed_first(jobs):
        about = [job.folder.name, job.status, job.reason, job.scene, job.model]
        settings = [job.overrides.get(key, "") for key in varied]
        metrics = [job.metrics[name] if is_number(job.metrics.get(name)) else "" for name in numbers]
        writer.writerow([*about, *settings, *metrics])
    return text.getvalue()


def results_table(jobs: Sequence[RunRecord], design: Design) -> str:
    """The complete jobs in Markdown, at most as wide as a terminal for usual sweeps; empty without such jobs.

    Names are shortened and extra columns left out, the last first, until it fits.
    """
    complete = [job for job in jobs if job.is_complete]
    if not complete:
        return ""
    columns = _columns(complete, jobs, design)
    table = _render(columns, complete, 0)
    for shortness in (0, 1):
        chosen = columns
        table = _render(chosen, complete, shortness)
        while _width(table) > WIDTH and shortness and any(column.is_extra for column in chosen):
            last = max(i for i, column in enumerate(chosen) if column.is_extra)
            chosen = chosen[:last] + chosen[last + 1 :]
            table = _render(chosen, complete, shortness)
        if _width(table) <= WIDTH:
            break
    return table


def _columns(complete: Sequence[RunRecord], jobs: Sequence[RunRecord], design: Design) -> list[Column]:
    short = short_keys(design.keys)
    columns = []
    if len(scenes_of(complete)) > 1:
        columns.append(Column(("scene",), lambda job: job.scene or NOTHING))
    if len({job.model for job in jobs}) > 1 or not design.keys:
        columns.append(Column(("model",), lambda job: job.model or NOTHING))
    columns += [Column((short[key],), _setting(key)) for key in design.keys]
    if len({tuple(column.cell(job) for column in columns) for job in complete}) < len(complete):
        columns.insert(0, Column(("job",), lambda job: job.folder.name))
    columns.append(Column(("registered", "reg."), registered))
    for measure in measures_of(complete):
        title = measure.title.split(",")[0]
        if not measure.has_unit:
            if measure.metric != "registered_share":
                columns.append(Column((title,), _metric(measure.metric)))
            continue
        brief = BRIEF.get(title, title)
        names = tuple(in_header(name, complete, measure.metric) for name in (title, brief))
        columns.append(Column(names, _error(measure.metric, complete)))
    if any(job.number("index_ratio_sigma") is not None for job in complete):
        columns.append(Column(("estimated ratio", "ratio"), _estimated))
    columns.append(Column(("seconds", "s"), lambda job: rounded(job, "seconds_total", 1), is_extra=True))
    return columns


def _render(columns: Sequence[Column], jobs: Sequence[RunRecord], shortness: int) -> str:
    header = [column.names[min(shortness, len(column.names) - 1)] for column in columns]
    return markdown_table(header, [[column.cell(job) for column in columns] for job in jobs])


def _width(table: str) -> int:
    return max(map(len, table.splitlines()))


def _setting(key: str) -> Callable[[RunRecord], str]:
    return lambda job: job.overrides.get(key) or NOTHING


def _metric(name: str) -> Callable[[RunRecord], str]:
    def cell(job: RunRecord) -> str:
        value = job.number(name)
        if value is None:
            return NOTHING
        return f"{value:.0f}" if value.is_integer() else f"{value:.3f}"

    return cell


def _error(stem: str, jobs: Sequence[RunRecord]) -> Callable[[RunRecord], str]:
    return lambda job: error_text(job, jobs, stem)


def _estimated(job: RunRecord) -> str:
    return NOTHING if job.number("index_ratio_sigma") is None else rounded(job, "index_ratio", 4)
