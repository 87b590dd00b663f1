"""The jobs of a sweep as their folders tell of them, and what was varied between them."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

COMPLETE, FAILED, RUNNING = "complete", "failed", "running"
UNSAID = ("out", "hydra")  # keys of a command line that say nothing about the result, with all below them
PLACES = ("scene.path", "scene.name")  # told by the scene's name already
METHOD = ("dense", "dense.method")  # which dense stage: told by the metric dense_method


@dataclass(frozen=True)
class Job:
    """One run of a sweep: its folder, what was asked for (`settings`, by key) and what came out (`metrics`).

    `metrics` is empty where metrics.json could not be read; status and reason say so. model and scene are empty where
    nothing tells of them.
    """

    folder: Path
    status: str
    reason: str
    scene: str
    model: str
    settings: Mapping[str, str]
    metrics: Mapping[str, Any]

    @property
    def is_complete(self) -> bool:
        """Whether the job has results to show."""
        return self.status == COMPLETE

    def number(self, name: str) -> float | None:
        """A metric as a finite number; None where there is none."""
        value = self.metrics.get(name)
        return float(value) if is_number(value) else None


@dataclass(frozen=True)
class Design:
    """What differs between the jobs, by keys of the command line beside scene and model.

    x: what the figures have along their horizontal axis, None without a number that was varied; told_apart: every other
    key, in the order of the command line; averaged: seeds, which are alike.
    """

    x: str | None
    told_apart: tuple[str, ...]
    averaged: tuple[str, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """All of them, x first."""
        return (*([self.x] if self.x else []), *self.told_apart, *self.averaged)


def load_jobs(runs: Sequence[Path]) -> list[Job]:
    """The jobs in the order of `runs`; one whose metrics.json is missing or damaged has failed, for that reason."""
    return [load_job(run) for run in runs]


def load_job(run: Path) -> Job:
    """The job whose folder is `run`; see load_jobs."""
    metrics, reason = _read(run / "metrics.json")
    overrides = metrics.get("overrides")
    said = {str(key): str(value) for key, value in overrides.items()} if isinstance(overrides, dict) else {}
    capture = metrics.get("capture") or said.get("scene.path")
    scene = metrics.get("scene") or (Path(capture).name if isinstance(capture, str) else "") or said.get("scene", "")
    if "scene.path" in said and scene == said.get("scene"):
        scene = Path(said["scene.path"]).name
    model = metrics.get("model") or said.get("model", "")
    status = FAILED if reason else str(metrics.get("status", FAILED))
    if status == RUNNING:
        status, reason = FAILED, "came to a sudden end, or is still running"
    if status != COMPLETE and not reason:
        reason = " ".join(str(metrics.get("reason") or "metrics.json gives no reason").split())
    return Job(run, status, reason, str(scene), str(model), said, metrics)


def _read(path: Path) -> tuple[dict[str, Any], str]:
    """The content of a metrics.json, and why there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}, "metrics.json is missing"
    except OSError as error:
        return {}, f"metrics.json cannot be read: {error.strerror}"
    except ValueError as error:  # no JSON, or no UTF-8
        return {}, f"metrics.json is damaged: {' '.join(str(error).split())}"
    if not isinstance(content, dict):
        return {}, "metrics.json is damaged: it must be an object"
    return content, ""


def what_varied(jobs: Sequence[Job]) -> Design:
    """What differs between the jobs; of those whose command line is unknown nothing is concluded.

    An index ratio goes along the axis if there is one, else the number with the most values. Numbers are what complete
    jobs have as numbers: a failed one may have anything.
    """
    known = [job for job in jobs if job.settings]
    keys = dict.fromkeys(key for job in known for key in job.settings)
    varied = [key for key in keys if _says_something(key) and len({job.settings.get(key) for job in known}) > 1]
    varied = [key for key in varied if key not in PLACES or not _follows_scene(known, key)]
    averaged = tuple(key for key in varied if short_key(key) == "seed")
    others = [key for key in varied if key not in averaged]
    numeric = [key for key in others if _is_numeric(known, key)]
    numeric.sort(key=lambda key: (not key.endswith("index_ratio"), -len({job.settings.get(key) for job in known})))
    x = numeric[0] if numeric else None
    return Design(x, tuple(key for key in others if key != x), averaged)


def _says_something(key: str) -> bool:
    return key not in ("scene", "model") and key.partition(".")[0] not in UNSAID


def _follows_scene(jobs: Sequence[Job], key: str) -> bool:
    """Whether no two values of the key have the same scene."""
    pairs = {(job.scene, job.settings.get(key)) for job in jobs}
    return len({scene for scene, _ in pairs}) == len(pairs)


def _is_numeric(jobs: Sequence[Job], key: str) -> bool:
    values = [value_of(job, key) for job in jobs if job.is_complete]
    return bool(values) and None not in values


def value_of(job: Job, key: str) -> float | None:
    """What the job's command line says of the key, as a finite number; None where it is none."""
    try:
        value = float(job.settings.get(key, ""))
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value of metrics.json is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


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


def failed_first(jobs: Sequence[Job]) -> list[Job]:
    """The same jobs, those without results before the others."""
    return sorted(jobs, key=lambda job: job.is_complete)


def scenes_of(jobs: Iterable[Job]) -> list[str]:
    """The names of the scenes, in the order of the jobs."""
    return list(dict.fromkeys(job.scene for job in jobs))
