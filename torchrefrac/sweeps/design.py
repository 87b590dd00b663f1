"""What was varied between the runs of a sweep, and which of them stand side by side in the figures."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchrefrac.files.run import METRICS, RunRecord, RunRecordError, RunStatus

WITHOUT_EFFECT = ("out", "hydra")  # keys of a command line that do not change the result, with all below them
PLACES = ("scene.path", "scene.name")  # which the scene's name stands for
METHOD = ("dense", "dense.method")  # which dense stage, as does the metric dense_method
MOST_PANELS = 6  # side by side
FIGURES = ("figure1", "dense_figure1", "dense_error_map")  # of reconstructions; how the names of the files begin


@dataclass(frozen=True)
class Design:
    """What differs between the jobs, by keys of the command line beside scene and model.

    x: what the figures have along their horizontal axis, None without a number that was varied; distinguished: every
    other key, in the order of the command line; averaged: seeds, which are alike.
    """

    x: str | None
    distinguished: tuple[str, ...]
    averaged: tuple[str, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """All of them, x first."""
        return (*([self.x] if self.x else []), *self.distinguished, *self.averaged)


def load_runs(folders: Sequence[Path]) -> list[RunRecord]:
    """The records of the runs in `folders`, in their order; see load_run."""
    return [load_run(folder) for folder in folders]


def load_run(folder: Path) -> RunRecord:
    """The record of a run that has ended. One without a readable record, or that is still running, has failed, for that
    reason; only complete runs have none."""
    try:
        record = RunRecord.read(folder)
    except RunRecordError as error:
        reason = str(error).replace(str(folder / METRICS), METRICS)
        return RunRecord(folder, RunStatus.FAILED, reason=reason)
    if record.is_complete:
        return record
    if record.status is RunStatus.RUNNING:
        return replace(record, status=RunStatus.FAILED, reason="came to a sudden end, or is still running")
    status = RunStatus.INTERRUPTED if record.status is RunStatus.INTERRUPTED else RunStatus.FAILED
    return replace(record, status=status, reason=record.reason or f"{METRICS} gives no reason")


def what_varied(jobs: Sequence[RunRecord]) -> Design:
    """What differs between the jobs; of those whose command line is unknown nothing is concluded.

    An index ratio goes along the axis if there is one, else the number with the most values. Numbers are what complete
    jobs have as numbers: a failed one may have anything.
    """
    known = [job for job in jobs if job.overrides]
    keys = dict.fromkeys(key for job in known for key in job.overrides)
    count = {key: len({job.overrides.get(key) for job in known}) for key in keys}
    varied = [key for key in keys if count[key] > 1 and not _is_beside_the_point(known, key)]
    averaged = tuple(key for key in varied if short_key(key) == "seed")
    others = [key for key in varied if key not in averaged]
    numeric = [key for key in others if _is_numeric(known, key)]
    x = min(numeric, key=lambda key: (not key.endswith("index_ratio"), -count[key]), default=None)
    return Design(x, tuple(key for key in others if key != x), averaged)


def _is_beside_the_point(jobs: Sequence[RunRecord], key: str) -> bool:
    """Whether the key changes no result, or only with scene and model: no two of its values have the same scene."""
    if key not in PLACES:
        return key in ("scene", "model") or key.partition(".")[0] in WITHOUT_EFFECT
    pairs = {(job.scene, job.overrides.get(key)) for job in jobs}
    return len({scene for scene, _ in pairs}) == len(pairs)


def _is_numeric(jobs: Sequence[RunRecord], key: str) -> bool:
    values = [value_of(job, key) for job in jobs if job.is_complete]
    return bool(values) and None not in values


def value_of(job: RunRecord, key: str) -> float | None:
    """What the job's command line says of the key, as a finite number; None where it is none."""
    try:
        value = float(job.overrides.get(key, ""))
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def short_key(key: str) -> str:
    """The last part of a dotted key."""
    return key.rsplit(".", 1)[-1]


def short_keys(keys: Sequence[str]) -> dict[str, str]:
    """A short name for each key: its last part where that is unique."""
    last = [short_key(key) for key in keys]
    return {
        key: name if last.count(name) == 1 and name not in ("scene", "model") else key
        for key, name in zip(keys, last, strict=True)
    }


def has_paper_form(design: Design) -> bool:
    """Whether only scene, model and dense method vary, as in the paper's Table 1."""
    return all(key in METHOD for key in design.keys)


def scenes_of(jobs: Iterable[RunRecord]) -> list[str]:
    """The names of the scenes, in the order of the jobs."""
    return list(dict.fromkeys(job.scene for job in jobs))


def shown_together(jobs: Sequence[RunRecord], design: Design) -> dict[str, list[RunRecord]]:
    """The complete jobs that share a figure, by what ends the name of its file, such as `_tank_1.2.png`.

    They have one capture and differ in model or dense method alone; of seeds the first is taken. A figure has at least
    2 jobs (1 where only scene, model and dense method vary) and at most 6.
    """
    others = [key for key in design.keys if key not in (*METHOD, *design.averaged)]
    groups: dict[tuple[str, ...], list[RunRecord]] = {}
    for job in jobs:
        if job.is_complete:
            values = tuple(job.overrides.get(key, "") for key in others)
            groups.setdefault((str(job.capture or ""), job.scene, *values), []).append(job)
    if design.averaged:
        groups = {group: _first_of_each(members) for group, members in groups.items()}
    fewest = 1 if has_paper_form(design) else 2
    shown = {group: members for group, members in groups.items() if fewest <= len(members) <= MOST_PANELS}
    if len(groups) == 1 and shown:
        return {".png": next(iter(shown.values()))}
    named: dict[str, list[RunRecord]] = {}
    for (_, *words), members in shown.items():
        stem = "_".join(_fit_for_a_file(word) for word in words if word)
        end, number = f"_{stem}.png", 2
        while end in named:
            end, number = f"_{stem}_{number}.png", number + 1
        named[end] = members
    return named


def _first_of_each(jobs: Sequence[RunRecord]) -> list[RunRecord]:
    first: dict[tuple[str, str], RunRecord] = {}
    for job in jobs:
        first.setdefault((job.model, str(job.metrics.get("dense_method", ""))), job)
    return list(first.values())


def _fit_for_a_file(word: str) -> str:
    return re.sub(r"[^\w.+-]+", "-", word).strip("-.") or "-"
