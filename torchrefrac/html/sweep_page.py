"""The report of a whole sweep, and those of its runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchrefrac.files.run import REPORT, RunRecord
from torchrefrac.html.contents import read_contents
from torchrefrac.html.drawn import Drawn, draw_dense_beside, draw_models, kind_of
from torchrefrac.html.page import Picture, picture, write_page
from torchrefrac.html.run_page import report_link, write_report
from torchrefrac.html.tables import Entry, Table, files_of, table1
from torchrefrac.html.words import distinct, model_order, model_title, models_words, seconds
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Truth
from torchrefrac.scene.interfaces import SURFACE
from torchrefrac.scene.wording import INTERFACE, wording
from torchrefrac.sweeps.design import MOST_PANELS, load_runs, short_keys, shown_together, what_varied

SUMMARY, SUMMARY_WIDTH = "summary.png", 1600
MOST_FIGURES = 12
DEFAULT = "by default"


@dataclass(frozen=True)
class Failed:
    """A job without a result, what it is called, and the link to its own report (empty: it has none)."""

    job: RunRecord
    label: str
    link: str


@dataclass(frozen=True)
class SceneSection:
    """Complete jobs on the same photographs; number: of the figure, where there is one."""

    title: str
    table: Table
    figure: Drawn | None
    number: int


def write_job_reports(runs: Sequence[Path], recorder: Recorder) -> None:
    """Write report.html into every run folder of a sweep. Raises OSError where one cannot be written."""
    jobs = load_runs(runs)
    groups = [[job.folder for job in members] for members in shown_together(jobs, what_varied(jobs)).values()]
    for run in recorder.track(runs, len(runs), "reports", "run"):
        beside = next((group for group in groups if run in group), [])
        write_report(run, [other for other in beside if other != run])


def write_sweep_report(folder: Path, runs: Sequence[Path]) -> Path:
    """Write `folder`/report.html of the jobs `runs`, the failed ones first with their reasons; returns its path.

    It holds summary.png where that lies in the folder, the table and the side view of each scene, and links to the
    jobs' own reports, which must be written before. Raises OSError where the page cannot be written.
    """
    jobs = load_runs(runs)
    short = short_keys(what_varied(jobs).keys)
    summary = _summary(folder / SUMMARY)
    sections = _sections([job for job in jobs if job.is_complete], short, folder, 1 if summary is None else 2)
    failed = [job for job in jobs if not job.is_complete]
    write_page(
        "sweep.html",
        folder / REPORT,
        title=f"{len(jobs)} jobs: {_listed([section.title for section in sections])}" if sections else "Sweep",
        verdict=_verdict(jobs, failed),
        total=seconds(sum(job.number("seconds_total") or 0.0 for job in jobs)),
        models=models_words(jobs),
        varied={
            key: list(dict.fromkeys(job.overrides.get(key, DEFAULT) for job in jobs if job.overrides)) for key in short
        },
        failed=[Failed(job, _label(job, short) or job.folder.name, report_link(job, folder)) for job in failed],
        summary=summary,
        summary_kind="" if summary is None else kind_of(summary),
        sections=sections,
        dense=_dense(jobs, folder),
        drawn=(summary is not None) + sum(section.figure is not None for section in sections),
        files=[cell for cell in files_of(folder) if not cell.link.startswith("multirun")],
    )
    return folder / REPORT


def _sections(jobs: Sequence[RunRecord], short: Mapping[str, str], folder: Path, first: int) -> list[SceneSection]:
    """first: the number of the first figure."""
    groups: dict[str, list[RunRecord]] = {}
    for job in jobs:
        groups.setdefault(str(job.capture or job.scene), []).append(job)
    found = []
    for number, group in enumerate(groups.values()):
        same = [key for key in short if len({job.overrides.get(key) for job in group}) == 1]
        ordered = sorted(group, key=model_order)
        shared = same if len(groups) > 1 else []
        shown = {key: name for key, name in short.items() if key not in shared}
        labels = distinct([_label(job, shown, with_scene=False) for job in ordered], ordered)
        title = ", ".join((group[0].scene, *(f"{short[key]} {group[0].overrides.get(key, DEFAULT)}" for key in shared)))
        entries = [Entry(label, job, report_link(job, folder)) for label, job in zip(labels, ordered, strict=True)]
        unit = next((job.length_unit for job in group if job.length_unit), "")
        figure, truths = None, dict[Path, Truth | None]()
        if number < MOST_FIGURES and 2 <= len(ordered) <= MOST_PANELS:  # fewer have nothing beside them
            figure = draw_models([read_contents(job.folder, truths, with_capture=False) for job in ordered], labels)
        drawn = sum(section.figure is not None for section in found)
        found.append(SceneSection(title, table1(entries, unit), figure, first + drawn))
    return found


def _dense(jobs: Sequence[RunRecord], folder: Path) -> list[Drawn]:
    """Dense surfaces side by side, of each scene and combination of what else varied, as they lie in the folder."""
    groups = shown_together(jobs, what_varied(jobs))
    found = []
    for end, (first, *_) in list(groups.items())[:MOST_FIGURES]:
        drawn = draw_dense_beside(folder, end, wording(first.metrics.get(INTERFACE, SURFACE)))
        of = end.removesuffix(".png").replace("_", " ")
        found += [replace(one, title=f"{one.title}{f', {of.strip()}' if of else ''}") for one in drawn]
    return found


def _label(job: RunRecord, short: Mapping[str, str], with_scene: bool = True) -> str:
    words = [job.scene] if with_scene and job.scene else []
    words += [model_title(job.model)] if job.model else []
    words += [f"{name} {job.overrides[key]}" for key, name in short.items() if key in job.overrides]
    return ", ".join(words)


def _summary(path: Path) -> Picture | None:
    try:
        return picture(path, SUMMARY_WIDTH) if path.is_file() else None
    except OSError:
        return None


def _verdict(jobs: Sequence[RunRecord], failed: Sequence[RunRecord]) -> str:
    done = f"{len(jobs) - len(failed)} of {len(jobs)} jobs are complete"
    return f"{done}; {len(failed)} failed or did not finish." if failed else f"{done}."


def _listed(words: Sequence[str]) -> str:
    """At most four of them."""
    different = list(dict.fromkeys(words))
    return ", ".join(different[:4]) + (" …" if len(different) > 4 else "")
