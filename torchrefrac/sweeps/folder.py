"""The folder of a sweep: what it holds from before, whether that may stay, and its jobs; imports nothing slow.

Also failures that a run could not record itself, and what to say of folders that cannot be used.
"""

import errno
import tempfile
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from torchrefrac.errors import TorchrefracError
from torchrefrac.files.run import METRICS, RunRecord
from torchrefrac.sweeps.jobs import NO_SETTINGS, Job, by_name, read_sweep, record_of, remembered, write_sweep

MISSING = "not there"
FULL = (errno.ENOSPC, errno.EDQUOT)
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


class SweepError(TorchrefracError, ValueError):
    """No job of the sweep can be run; the message says why."""


class SweepFolder:
    """A folder and the jobs in it; `complete` are those that need not run again.

    What a job's own folder does not take is kept in sweep.json. Raises SweepError where the folder holds something else
    than these jobs.
    """

    def __init__(self, path: Path, jobs: tuple[Job, ...]) -> None:
        self.path, self.jobs = path, _in_folder(jobs, path)
        self.complete = [job for job in self.jobs if record_of(job, path).is_complete]
        self._lost: dict[str, str] = {}
        self._before: dict[str, bytes | None] = {}

    def require_same_settings(self, options: Mapping[str, Mapping[str, Any] | str]) -> None:
        """Raise SweepError where a complete job was made with other settings than it would be now.

        options: by the folders of the jobs, or why a job cannot have any.
        """
        for job in self.complete:
            now = options[job.folder]
            found = now if isinstance(now, str) else _difference(self.path / job.folder, now)
            if found:
                raise SweepError(
                    f"{self.path / job.folder} was made with other settings ({found}); delete it to have it made "
                    "again, or give another folder as out=DIR"
                )

    def save(self) -> None:
        """Write sweep.json, with the failures that the jobs' own folders do not take.

        Raises SweepError where it cannot be written.
        """
        try:
            write_sweep([replace(job, reason=self._lost.get(job.folder, "")) for job in self.jobs], self.path)
        except OSError as error:
            raise SweepError(unusable(self.path, error)) from None

    def save_failures(self) -> None:
        """The same once all have ended, where there is something new to be kept."""
        if self._lost:
            self.save()

    def make_ready(self, job: Job) -> bool:
        """Make the job's folder, and remember the record of an earlier attempt; False where that cannot be done."""
        run = self.path / job.folder
        try:
            run.mkdir(parents=True, exist_ok=True)
            self._before[job.folder] = self._record(job)
            with tempfile.TemporaryFile(dir=run):
                return True
        except OSError as error:
            self._lost[job.folder] = unusable(run, error)
            return False

    def has_record(self, job: Job) -> bool:
        """Whether the job has left a metrics.json since it was made ready."""
        return self._record(job) not in (None, self._before.get(job.folder))

    def _record(self, job: Job) -> bytes | None:
        path = self.path / job.folder / METRICS
        return path.read_bytes() if path.is_file() else None

    def fail(self, job: Job, reason: str, model: str, scene: str) -> None:
        """Record a failure that the job could not record itself; model and scene are the defaults."""
        chosen = by_name(job.overrides)
        model, scene = chosen.get("model", model), chosen.get("scene", scene)
        try:
            write_failure(self.path / job.folder, reason, model, scene, job.overrides)
        except OSError:
            self._lost[job.folder] = reason


def _in_folder(jobs: tuple[Job, ...], folder: Path) -> tuple[Job, ...]:
    """The jobs with the folders that they had before."""
    try:
        known = read_sweep(folder)
    except ValueError as error:
        raise SweepError(str(error)) from None
    if known is None:
        if (folder / METRICS).exists() or any(folder.glob(f"*/{METRICS}")):
            raise SweepError(f"{folder} holds results that are not of this sweep; give another folder as out=DIR")
        return jobs
    same = remembered(jobs, known)
    if same is None:
        example = next((job.label for job in known if job.overrides not in {j.overrides for j in jobs}), known[0].label)
        raise SweepError(
            f"{folder} holds another sweep ({len(known)} jobs, one of them {example}); give another folder as out=DIR"
        )
    return same


def _difference(run: Path, options: Mapping[str, Any]) -> str:
    """The first option that differs, with both values; empty where none does or the run did not keep its options."""
    path = run / ".hydra" / "config.yaml"
    if not path.is_file():
        return ""
    before, now = _flat(yaml.safe_load(path.read_text(encoding="utf-8"))), _flat(options)
    for name in sorted(before.keys() | now.keys()):
        was, is_now = before.get(name, MISSING), now.get(name, MISSING)
        if name not in NO_SETTINGS and was != is_now:
            return f"{name} was {was} and is {is_now} now"
    return ""


def _flat(values: Any, path: str = "") -> dict[str, Any]:
    if not isinstance(values, Mapping) or not values:
        return {path: values}
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{path}.{key}" if path else str(key))
    return flat


def write_failure(folder: Path, reason: str, model: str, scene: str, overrides: Iterable[str]) -> None:
    """metrics.json of a job that failed before its run began, or beside it.

    Raises OSError where the folder does not take it.
    """
    about = {"status": "failed", "stages": [], "model": model, "scene": scene, "overrides": by_name(overrides)}
    RunRecord.of(folder, about | {"reason": reason}).write()


def append_traceback(error: BaseException, folder: Path) -> None:
    """Keep in run.log where an error came from. Raises OSError where the folder does not take it."""
    with (folder / "run.log").open("a", encoding="utf-8") as log:
        log.write("".join(traceback.format_exception(error)))


def file_sentence(error: OSError, folder: Path | None) -> str:
    """Which file or disk cannot be used, and what to do; `folder` is where results go, for errors without a file."""
    place = error.filename2 or error.filename or folder
    if error.errno in FULL:
        disk = "the disk" if place is None else f"the disk that holds {folder or Path(str(place)).parent}"
        return f"{disk} is full; make room there, or give a folder elsewhere as out=DIR"
    problem = error.strerror or type(error).__name__
    if place is None:
        return problem
    remedy = "; where results should go there, give another folder as out=DIR" if error.errno in FORBIDDEN else ""
    return f"{place} cannot be used ({problem}){remedy}"


def unusable(folder: Path, error: OSError) -> str:
    """The sentence for a folder that results cannot go to."""
    problem = error.strerror or type(error).__name__
    return f"{folder} cannot be written to ({problem}); make it a folder that can, or give another as out=DIR"
