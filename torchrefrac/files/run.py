"""What the files in the folder of a run are called, and metrics.json, its record; imports nothing that is slow."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Self, TypeGuard

from torchrefrac.atomic import replacing
from torchrefrac.errors import TorchrefracError
from torchrefrac.files.swap import settle

METRICS = "metrics.json"
REPORT, SCENE_PAGE = "report.html", "scene.html"
PAGES = (REPORT, SCENE_PAGE)  # of all that lies in the folder
DENSE_CLOUD = "dense.ply"
DENSE_VIEW, ERROR_MAP, PROFILES = "dense_view.png", "error_map.png", "profiles.png"
SURFACE_VIEW = "surface_view.png"
DENSE_LAZ, POINTS_LAZ, CONTOURS = "dense.laz", "points.laz", "contours.geojson"
RASTERS = {name: f"{name}.tif" for name in ("dsm", "depth", "sigma", "views", "hillshade", "orthophoto")}
FOR_SURVEYS = (DENSE_LAZ, POINTS_LAZ, CONTOURS, *RASTERS.values())
DENSE_RESULTS = (
    DENSE_CLOUD, "mesh.ply", "dsm.npz", "dsm.png", *FOR_SURVEYS, PROFILES, DENSE_VIEW, SURFACE_VIEW, ERROR_MAP,
)  # fmt: skip
DEPTH_MAPS = "dense"  # the folder of the depth maps
PARTS = f"{DEPTH_MAPS}/parts"  # of what is finished while the stage is not
WORK = "work"  # the same of stages before it
TEXTS = ("status", "reason", "command", "model", "scene", "capture", "length_unit")
KINDS: dict[str, type] = {"stages": list, "overrides": dict, **dict.fromkeys(TEXTS, str)}  # in metrics.json
WORDS: dict[type, str] = {list: "a list", dict: "an object", str: "a text"}
MOST_CHARACTERS = 10_000  # of one of them
UNIT_STEMS = ("camera_rms_", "camera_sigma_median_", "point_sigma_median_")  # metrics that end in the length unit


class RunStatus(StrEnum):
    """How far a run is; UNKNOWN where metrics.json is not there or does not say it."""

    RUNNING = "running"
    COMPLETE = "complete"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    UNKNOWN = "unknown"


class RunRecordError(TorchrefracError, ValueError):
    """metrics.json is missing or damaged; the message names the file and says in one sentence what is wrong."""


@dataclass(frozen=True)
class RunRecord:
    """What `folder`/metrics.json says of a run; empty where it says nothing.

    stages: those that are complete. reason: why the run did not come to its end, on one line. command: "adjust",
    "correct", "export" or "triangulate", or empty for a reconstruction. scene: its name, or that of the folder of the
    photographs. capture: that folder. overrides: the options of the command line, by name. metrics: all that the file
    holds, these fields too.
    """

    folder: Path
    status: RunStatus = RunStatus.UNKNOWN
    stages: tuple[str, ...] = ()
    reason: str = ""
    command: str = ""
    model: str = ""
    scene: str = ""
    capture: Path | None = None
    overrides: Mapping[str, str] = field(default_factory=dict)
    length_unit: str = ""
    metrics: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, metrics: Mapping[str, Any]) -> Self:
        """The record of a run in `folder` with these metrics. Raises RunRecordError where what it says of the
        run itself is of another kind than it must be."""
        for name, wanted in KINDS.items():
            value, is_damaged = metrics.get(name), f"{folder / METRICS} is damaged: {name}"
            if not isinstance(value, wanted | None):
                raise RunRecordError(f"{is_damaged} is {value!r}, but must be {WORDS[wanted]}")
            if value is not None and len(value) > MOST_CHARACTERS:
                raise RunRecordError(f"{is_damaged} is {len(value)} long, but may be {MOST_CHARACTERS} at most")
        status, stages, capture = (metrics.get(name) for name in ("status", "stages", "capture"))
        overrides = {str(key): str(value) for key, value in (metrics.get("overrides") or {}).items()}
        return cls(
            folder,
            RunStatus(status) if status in list(RunStatus) else RunStatus.UNKNOWN,
            tuple(map(str, stages or ())),
            " ".join(str(metrics.get("reason") or "").split()),
            str(metrics.get("command") or ""),
            str(metrics.get("model") or overrides.get("model", "")),
            _scene(metrics, overrides),
            Path(capture) if isinstance(capture, str) else None,
            overrides,
            str(metrics.get("length_unit") or _unit(metrics)),
            metrics,
        )

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read `folder`/metrics.json. Raises RunRecordError where it is missing or damaged."""
        settle(folder)
        path = folder / METRICS
        try:
            content = json.loads(path.read_text(encoding="utf-8-sig"))
        except FileNotFoundError:
            raise RunRecordError(f"{path} is missing") from None
        except OSError as error:
            raise RunRecordError(f"{path} cannot be read: {error.strerror}") from None
        except (ValueError, RecursionError) as error:  # no JSON, or no UTF-8
            raise RunRecordError(f"{path} is damaged: {' '.join(str(error).split())}") from None
        if not isinstance(content, dict):
            raise RunRecordError(f"{path} is damaged: it must be an object")
        return cls.of(folder, content)

    def write(self) -> None:
        """Write metrics.json, whole or not at all. Raises OSError where the folder does not take it."""
        with replacing(self.folder / METRICS) as temporary:
            temporary.write_text(json.dumps(dict(self.metrics), indent=1) + "\n", encoding="utf-8")

    @property
    def is_complete(self) -> bool:
        """Whether the run has results to show."""
        return self.status is RunStatus.COMPLETE

    def number(self, name: str) -> float | None:
        """A metric as a finite number; None where there is none."""
        value = self.metrics.get(name)
        return float(value) if is_number(value) else None


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a metric is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _scene(metrics: Mapping[str, Any], overrides: Mapping[str, str]) -> str:
    """The scene's name, or that of the folder that was given on the command line where `capture` is all it says."""
    place = metrics.get("capture") or overrides.get("scene.path")
    scene = metrics.get("scene") or (Path(place).name if isinstance(place, str) else "") or overrides.get("scene", "")
    if "scene.path" in overrides and scene == overrides.get("scene"):
        return Path(overrides["scene.path"]).name
    return str(scene)


def _unit(metrics: Mapping[str, Any]) -> str:
    found = (name.removeprefix(stem) for stem in UNIT_STEMS for name in metrics if name.startswith(stem))
    return next((unit for unit in found if "_" not in unit), "")
