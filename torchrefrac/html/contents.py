"""What lies in a run folder, read as far as it can be."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.files.cameras import load_cameras, load_points
from torchrefrac.files.capture import load_capture
from torchrefrac.files.tracks import read_run
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Similarity
from torchrefrac.scene import Alignment, Assessment, Capture, Reconstruction, Truth

T = TypeVar("T")
UNREADABLE = (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError)  # of files that are damaged
OPTIONS, OVERRIDES = Path(".hydra/config.yaml"), Path(".hydra/overrides.yaml")


@dataclass(frozen=True)
class RunContents:
    """A run, however far it got; None or empty for what is missing, and `notes` say why.

    options: the text of all options; overrides: what the command line said. `aligned` maps the frame of the
    reconstruction to that of the truth.
    """

    folder: Path
    metrics: dict[str, Any] = field(default_factory=dict)
    options: str = ""
    overrides: tuple[str, ...] = ()
    reconstruction: Reconstruction | None = None
    capture: Capture | None = None
    truth: Truth | None = None
    aligned: Similarity | None = None
    notes: tuple[str, ...] = ()

    @property
    def status(self) -> str:
        """complete, failed, interrupted, running, or unknown."""
        return str(self.metrics.get("status", "unknown"))

    @property
    def model(self) -> str:
        return str(self.metrics.get("model", "?"))

    @property
    def scene(self) -> str:
        """What reports call the scene: its name, or that of the folder of the photographs."""
        return str(self.metrics.get("scene") or Path(self.metrics.get("capture", "?")).name)

    @property
    def unit(self) -> str:
        """The length unit; empty where nothing says it."""
        for source in (self.reconstruction, self.truth, self.capture):
            if source is not None:
                return source.length_unit
        return next((k.removeprefix("camera_rms_") for k in self.metrics if k.startswith("camera_rms_")), "")

    @property
    def shown(self) -> Reconstruction | None:
        """The reconstruction in the frame of the truth, where there is one."""
        if self.reconstruction is None or self.aligned is None:
            return self.reconstruction
        return _moved(self.reconstruction, self.aligned)


Truths = dict[Path, Truth | None]


def read_contents(folder: Path, truths: Truths, with_capture: bool = True) -> RunContents:
    """Read a run folder.

    truths: those read before, by the folder of the photographs, which are not read again. with_capture: also the
    photographs' capture.json, and the photographs for their size.
    """
    notes: list[str] = []
    metrics = _attempt(lambda: read_metrics_of(folder), notes) or {}
    options, overrides = read_options(folder, metrics)
    reconstruction = _attempt(lambda: _reconstruction(folder), notes, "The cameras and points cannot be read: ")
    place = Path(metrics["capture"]) if isinstance(metrics.get("capture"), str) else None
    truth = capture = aligned = None
    if place is not None and place.is_dir():
        if place not in truths:
            truths[place] = _attempt(lambda: load_truth(place), notes)
        truth = truths[place]
        capture = _attempt(lambda: load_capture(place), notes) if with_capture else None
    elif place is not None:
        notes.append(f"The photographs are not in {place} any more: what needs them or their truth is left out.")
    if reconstruction is not None and truth is not None:
        aligned = evaluate(replace(reconstruction, points=reconstruction.points[:0]), truth)[1]  # cameras decide it
        truth = truth if aligned is not None else None
    return RunContents(
        folder, metrics, options, overrides, reconstruction, capture, truth, aligned, tuple(dict.fromkeys(notes))
    )


def read_metrics_of(folder: Path) -> dict[str, Any]:
    """metrics.json, whatever is in it. Raises OSError or ValueError where it is missing or damaged."""
    path = folder / "metrics.json"
    if not path.is_file():
        raise ValueError(f"{path} is missing: the run never began, or its folder is another one")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path} holds {type(found).__name__}, but must hold an object")
    return found


def read_options(folder: Path, metrics: dict[str, Any]) -> tuple[str, tuple[str, ...]]:
    """All options as text, and the overrides of the command line as KEY=VALUE; empty where the folder lacks them."""
    options = _text(folder / OPTIONS)
    told = metrics.get("overrides")
    if isinstance(told, dict):
        return options, tuple(f"{key}={value}" for key, value in told.items())
    import yaml  # noqa: PLC0415 - only reports need it

    try:
        listed = yaml.safe_load(_text(folder / OVERRIDES))
    except yaml.YAMLError:
        listed = None
    return options, tuple(map(str, listed)) if isinstance(listed, list) else ()


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


def _attempt(read: Callable[[], T], notes: list[str], about: str = "") -> T | None:
    try:
        return read()
    except UNREADABLE as error:
        notes.append(f"{about}{str(error).rstrip('.') or type(error).__name__}.")
        return None


def _reconstruction(folder: Path) -> Reconstruction | None:
    """With points and observations, or points alone where an old run has no tracks.npz."""
    if not (folder / "cameras.json").is_file():
        return None
    cameras = load_cameras(folder / "cameras.json")
    if (folder / "tracks.npz").is_file() and bool(cameras.registered.any()):
        return _with_tracks(cameras, read_run(folder))
    if (folder / "points.ply").is_file():
        points, colors = load_points(folder / "points.ply")
        return replace(cameras, points=points, colors=colors)
    return cameras


def _with_tracks(cameras: Reconstruction, tracks: Alignment) -> Reconstruction:
    number = torch.tensor([cameras.names.index(name) for name in tracks.names])
    return replace(
        cameras,
        points=tracks.points,
        colors=tracks.colors,
        image=number[tracks.image],
        point=tracks.point,
        pixels=tracks.pixels,
    )


def _moved(scene: Reconstruction, change: Similarity) -> Reconstruction:
    known, covariance = scene.assessment, scene.assessment.center_covariance
    moved = Assessment() if covariance is None else replace(known, center_covariance=_turned(covariance, change))
    return replace(
        scene,
        rotation=change.apply_to_rotation(scene.rotation),
        center=change.apply(scene.center),
        points=change.apply(scene.points),
        assessment=moved,
    )


def _turned(covariance: Tensor, change: Similarity) -> Tensor:
    return change.scale**2 * change.rotation @ covariance @ change.rotation.mT
