"""The jobs of a sweep, as its folder remembers them in sweep.json, and how each has ended; imports nothing slow."""

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from torchrefrac.atomic import replacing
from torchrefrac.files.run import METRICS, RunRecord, RunRecordError, RunStatus

MEMORY = "sweep.json"
NO_SETTINGS = ("out", "cache", "quiet", "report", "objective")
"""What says where a job is and what it prints, not what it is."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep, as it was planned; a `RunRecord` says how it ended.

    folder: its name in the folder of the sweep, overrides: what its command line says, label: what of that differs
    between the jobs. reason: why it failed, where it could leave no metrics.json.
    """

    folder: str
    overrides: tuple[str, ...]
    label: str
    reason: str = ""


def plan(overrides: Sequence[Sequence[str]], models: Sequence[str]) -> tuple[Job, ...]:
    """Jobs with folders NUMBER_MODEL, numbered from 0 with as many digits as the last needs, so that they sort."""
    chosen = [tuple(text for text in job if text.partition("=")[0] not in NO_SETTINGS) for job in overrides]
    digits = len(str(len(chosen) - 1))
    return tuple(
        Job(f"{i:0{digits}}_{re.sub(r'[^A-Za-z0-9.+-]', '-', model)}", job, label)
        for i, (job, model, label) in enumerate(zip(chosen, models, _labels(chosen), strict=True))
    )


def by_name(overrides: Iterable[str]) -> dict[str, str]:
    """The overrides of a job by their names, as metrics.json keeps them: without the quotes around a text."""
    pairs = (text.partition("=") for text in overrides)
    return {key: _unquoted(value) for key, _, value in pairs if key not in NO_SETTINGS}


def read_sweep(folder: Path) -> tuple[Job, ...] | None:
    """The jobs that `folder` remembers; None where it holds no sweep. Raises ValueError where sweep.json is damaged."""
    path = folder / MEMORY
    if not path.is_file():
        return None
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))["jobs"]
        return tuple(Job(**entry | {"overrides": tuple(entry["overrides"])}) for entry in entries)
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path} is damaged; delete it, or give another folder as out=DIR") from None


def write_sweep(jobs: Sequence[Job], folder: Path) -> None:
    """Write sweep.json, whole or not at all."""
    with replacing(folder / MEMORY) as temporary:
        temporary.write_text(json.dumps({"jobs": [asdict(job) for job in jobs]}, indent=1) + "\n", encoding="utf-8")


def remembered(jobs: Sequence[Job], known: Sequence[Job]) -> tuple[Job, ...] | None:
    """`jobs` in their own order, with the folders that `known` gave them; None where it holds other jobs."""
    folders = {frozenset(job.overrides): job.folder for job in known}
    if len(jobs) != len(known) or {frozenset(job.overrides) for job in jobs} != set(folders):
        return None
    return tuple(replace(job, folder=folders[frozenset(job.overrides)]) for job in jobs)


def find_job(run: Path) -> tuple[int, int, Job] | None:
    """Position (from 1) and number of the sweep's jobs, and the job, whose folder `run` is; None outside a sweep."""
    jobs = read_sweep(run.parent) or ()
    return next(((i + 1, len(jobs), job) for i, job in enumerate(jobs) if job.folder == run.name), None)


def record_of(job: Job, folder: Path) -> RunRecord:
    """How the job ended; of status UNKNOWN where it did not begin, or ended without a record of it."""
    try:
        return RunRecord.read(folder / job.folder)
    except RunRecordError:
        return RunRecord(folder / job.folder, RunStatus.FAILED if job.reason else RunStatus.UNKNOWN, reason=job.reason)


def jobs_and_records(folder: Path) -> tuple[list[Job], list[RunRecord]]:
    """What sweep.json and the folders of its jobs say; without one, every folder that holds metrics."""
    jobs = list(read_sweep(folder) or ())
    if not jobs:
        names = sorted((path.parent.name for path in folder.glob(f"*/{METRICS}")), key=_number)
        jobs = [Job(name, (), name) for name in names]
    return jobs, [record_of(job, folder) for job in jobs]


def ending(position: int, total: int, job: Job, record: RunRecord) -> str:
    """One line on a job that has come to its end."""
    line = f"{opening(position, total, job)}: {record.status}"
    if record.reason:
        return f"{line}: {record.reason}"
    seconds = record.number("seconds_total")
    return line if seconds is None else f"{line} in {seconds:.1f} s"


def opening(position: int, total: int, job: Job) -> str:
    """Which of the jobs it is, and what it does."""
    return f"{position:>{len(str(total))}}/{total}  {job.label}"


def _unquoted(value: str) -> str:
    is_quoted = len(value) > 1 and value[0] == value[-1] == "'"
    return value[1:-1].replace("\\'", "'") if is_quoted else value


def _labels(jobs: Sequence[Sequence[str]]) -> list[str]:
    """The overrides that not all jobs share; all of them for a job alone."""
    common = set(jobs[0]).intersection(*jobs[1:]) if len(jobs) > 1 else set[str]()
    return [" ".join(text for text in job if text not in common) or "defaults" for job in jobs]


def _number(name: str) -> tuple[int, str]:
    first = name.split("_", maxsplit=1)[0]
    return (int(first) if first.isdigit() else 10**9), name
