"""The report of a whole sweep."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrefrac.report.html.contents import Truths, read_contents, read_metrics_of, read_options
from torchrefrac.report.html.drawn import Drawn, draw_models
from torchrefrac.report.html.embed import Picture, picture
from torchrefrac.report.html.page import write_page
from torchrefrac.report.html.run_page import MOST_PANELS, ORDER, REPORT, relative_report
from torchrefrac.report.html.tables import Entry, Table, files_of, table1
from torchrefrac.report.html.words import MODELS, model_title, seconds

SUMMARY, SUMMARY_WIDTH = "summary.png", 1600
MOST_FIGURES = 12
SAID_ELSEWHERE = ("scene", "model", "out", "cache", "quiet")
DEFAULT = "by default"


@dataclass(frozen=True)
class Job:
    """A job of a sweep: its folder, metrics, overrides, and the link to its own report (empty: it has none)."""

    run: Path
    metrics: dict[str, Any]
    overrides: dict[str, str]
    link: str

    @property
    def complete(self) -> bool:
        return self.metrics.get("status") == "complete"

    @property
    def scene(self) -> str:
        return str(self.metrics.get("scene") or Path(str(self.metrics.get("capture", ""))).name or "?")

    @property
    def reason(self) -> str:
        return str(self.metrics.get("reason") or "no reason is known")


@dataclass(frozen=True)
class SceneSection:
    """Complete jobs on the same photographs."""

    title: str
    table: Table
    figure: Drawn | None


def write_sweep_report(folder: Path, runs: Sequence[Path]) -> Path:
    """Write `folder`/report.html of the jobs `runs`, the failed ones first with their reasons; returns its path.

    It holds summary.png where that lies in the folder, and Table 1 and Figure 1 of each scene, and links to the jobs'
    own reports, which must be written before. Raises OSError where the page cannot be written.
    """
    jobs = [_job(run, folder) for run in runs]
    varied = varied_overrides(jobs)
    sections = _sections([job for job in jobs if job.complete], varied)
    failed = [job for job in jobs if not job.complete]
    write_page(
        "sweep.html",
        folder / REPORT,
        title=f"{len(jobs)} jobs: {_listed([section.title for section in sections])}" if sections else "Sweep",
        verdict=_verdict(jobs, failed),
        total=seconds(sum(float(job.metrics.get("seconds_total") or 0.0) for job in jobs)),
        models={model_title(name): MODELS[name] for name in ORDER if any(_model(job) == name for job in jobs)},
        varied={
            key: list(dict.fromkeys(job.overrides.get(key, DEFAULT) for job in jobs if job.overrides)) for key in varied
        },
        failed=[(_label(job, varied) or job.run.name, job) for job in failed],
        summary=_summary(folder / SUMMARY),
        sections=sections,
        files=[cell for cell in files_of(folder) if not cell.link.startswith("multirun")],
    )
    return folder / REPORT


def varied_overrides(jobs: Sequence[Job]) -> list[str]:
    """The overrides whose values differ between the jobs, but for those that have places of their own."""
    keys = dict.fromkeys(key for job in jobs for key in job.overrides if key not in SAID_ELSEWHERE)
    told = [job.overrides for job in jobs if job.overrides]
    return [key for key in keys if len({overrides.get(key) for overrides in told}) > 1]


def _job(run: Path, folder: Path) -> Job:
    try:
        metrics = read_metrics_of(run)
    except (OSError, ValueError) as error:
        metrics = {"status": "failed", "reason": str(error)}
    _, listed = read_options(run, metrics)
    overrides = {key: value for key, _, value in (item.partition("=") for item in listed)}
    link = relative_report(run, folder) if (run / REPORT).is_file() else ""
    return Job(run, metrics, overrides, link)


def _sections(jobs: Sequence[Job], varied: Sequence[str]) -> list[SceneSection]:
    groups: dict[str, list[Job]] = {}
    for job in jobs:
        groups.setdefault(str(job.metrics.get("capture", job.scene)), []).append(job)
    found = []
    for number, group in enumerate(groups.values()):
        same = [key for key in varied if len({job.overrides.get(key) for job in group}) == 1]
        ordered = sorted(group, key=lambda job: ORDER.index(_model(job)) if _model(job) in ORDER else len(ORDER))
        shared = same if len(groups) > 1 else []
        labels = [_label(job, [key for key in varied if key not in shared], with_scene=False) for job in ordered]
        labels = [
            label if labels.count(label) == 1 else f"{label} [{job.run.name}]"
            for label, job in zip(labels, ordered, strict=True)
        ]
        title = ", ".join(
            (group[0].scene, *(f"{_short(key, varied)} {group[0].overrides.get(key, DEFAULT)}" for key in shared))
        )
        table = table1([Entry(t, j.metrics, j.link) for t, j in zip(labels, ordered, strict=True)], _unit(group))
        drawn = _figure(ordered, labels) if number < MOST_FIGURES else None
        found.append(SceneSection(title, table, drawn))
    return found


def _figure(jobs: Sequence[Job], labels: Sequence[str]) -> Drawn | None:
    """Of two to six jobs; fewer have nothing beside them, more would be too small."""
    if not 2 <= len(jobs) <= MOST_PANELS:
        return None
    truths: Truths = {}
    return draw_models([read_contents(job.run, truths, with_capture=False) for job in jobs], labels)


def _label(job: Job, varied: Sequence[str], with_scene: bool = True) -> str:
    words = [job.scene] if with_scene and job.scene != "?" else []
    words += [model_title(_model(job))] if _model(job) else []
    words += [f"{_short(key, varied)} {job.overrides[key]}" for key in varied if key in job.overrides]
    return ", ".join(words)


def _short(key: str, varied: Sequence[str]) -> str:
    """The last part of a dotted key, where no other ends like it."""
    last = key.rpartition(".")[2]
    return last if sum(other.rpartition(".")[2] == last for other in varied) < 2 else key


def _model(job: Job) -> str:
    return str(job.metrics.get("model", ""))


def _unit(group: Sequence[Job]) -> str:
    keys = [key for job in group for key in job.metrics]
    for start in ("camera_rms_", "camera_sigma_median_", "point_sigma_median_"):
        for key in keys:
            if key.startswith(start):
                return key.removeprefix(start)
    return ""


def _summary(path: Path) -> Picture | None:
    try:
        return picture(path, SUMMARY_WIDTH) if path.is_file() else None
    except OSError:
        return None


def _verdict(jobs: Sequence[Job], failed: Sequence[Job]) -> str:
    done = f"{len(jobs) - len(failed)} of {len(jobs)} jobs are complete"
    return f"{done}." if not failed else f"{done}; {len(failed)} failed or did not finish."


def _listed(words: Sequence[str]) -> str:
    """At most four of them."""
    different: Mapping[str, None] = dict.fromkeys(words)
    return ", ".join([*different][:4]) + (" …" if len(different) > 4 else "")
