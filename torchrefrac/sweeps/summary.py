"""The summary of a sweep: summary.csv, summary.md and summary.png."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from torchrefrac.atomic import replacing
from torchrefrac.files.run import RunRecord
from torchrefrac.record.terminal import wrapped
from torchrefrac.sweeps.design import FIGURES, Design, load_runs, short_keys, shown_together, what_varied
from torchrefrac.sweeps.figure import draw_sweep
from torchrefrac.sweeps.table import csv_text, results_table

LINKS = {
    "summary.png": "errors over what was varied", "report.html": "all jobs on one page",
    "summary.csv": "every number of every job", "table1.md": "the paper's Table 1",
    "paper.html": "the paper's numbers and figures beside these",
}  # fmt: skip


class Summary(NamedTuple):
    """What to print of a sweep: the failed jobs with their reasons, and a table of the others; each may be empty."""

    failed: str
    table: str

    def __str__(self) -> str:
        return "\n\n".join(filter(None, self))


def write_summary(folder: Path, runs: Sequence[Path], to_come: Sequence[str] = ()) -> Summary:
    """Write summary.csv, summary.md and summary.png of the run folders `runs` into `folder`; returns what to print.

    The text is at most 100 columns wide for usual sweeps: the failed jobs with their reasons, then a table of the
    others. A run whose metrics.json is missing or damaged counts as failed. Without a complete job there is no
    summary.png, and one that an earlier sweep left is removed. summary.md links to the other files of the sweep that
    are there when it is written, and those that are `to_come`.

    Raises ValueError without runs.
    """
    if not runs:
        raise ValueError("runs is empty, but a summary needs at least one run folder")
    jobs = load_runs(runs)
    design = what_varied(jobs)
    if not draw_sweep(jobs, design, folder / "summary.png"):
        (folder / "summary.png").unlink(missing_ok=True)
    summary = Summary(failed_jobs(jobs, design), results_table(jobs, design))
    with replacing(folder / "summary.csv") as temporary:
        temporary.write_text(csv_text(jobs, design), encoding="utf-8", newline="")
    links = _links(folder, jobs, design, to_come)
    with replacing(folder / "summary.md") as temporary:
        temporary.write_text("\n\n".join(filter(None, (*summary, links))) + "\n", encoding="utf-8")
    return summary


def failed_jobs(jobs: Sequence[RunRecord], design: Design) -> str:
    """A Markdown list of the jobs without results and why, wrapped for the terminal; empty where there are none."""
    failed = [job for job in jobs if not job.is_complete]
    if not failed:
        return ""
    lines = [f"{len(failed)} of {len(jobs)} jobs failed:" if len(jobs) > 1 else "The job failed:", ""]
    short = short_keys(design.keys)
    for job in failed:
        chosen = (f"{short[key]}={job.overrides[key]}" for key in design.keys if key in job.overrides)
        about = ", ".join(filter(None, (job.scene, job.model, *chosen)))
        state = "" if job.status == "failed" else f"{job.status}: "
        lines.append(wrapped(f"- {job.folder.name}{f' ({about})' if about else ''}: {state}{job.reason}"))
    return "\n".join(lines)


def _links(folder: Path, jobs: Sequence[RunRecord], design: Design, to_come: Sequence[str]) -> str:
    figures = [f"{kind}{end}" for kind in FIGURES for end in shown_together(jobs, design)]
    names = LINKS | dict.fromkeys(figures, "reconstructions side by side")
    there = [name for name in names if name in to_come or (folder / name).is_file()]
    return "\n".join(f"- [{name}]({name}): {names[name]}" for name in there)
