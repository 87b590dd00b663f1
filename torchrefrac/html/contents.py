"""What lies in a run folder, read as far as it can be."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from jaxtyping import Float
from torch import Tensor

from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.files.cameras import CAMERAS, load_points, read_cameras
from torchrefrac.files.capture import load_capture
from torchrefrac.files.run import RunRecord
from torchrefrac.files.tracks import TRACKS, read_run
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Rigid, Similarity
from torchrefrac.scene import Assessment, Capture, Scene, Truth

T = TypeVar("T")
UNREADABLE = (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError)  # of files that are damaged
OPTIONS, OVERRIDES = Path(".hydra/config.yaml"), Path(".hydra/overrides.yaml")


@dataclass(frozen=True)
class RunContents:
    """A run, however far it got; None or empty for what is missing, and `notes` say why.

    options: the text of all options; overrides: those of the command line as KEY=VALUE. `aligned` maps the frame of the
    scene to that of the truth.
    """

    record: RunRecord
    options: str = ""
    overrides: tuple[str, ...] = ()
    scene: Scene | None = None
    capture: Capture | None = None
    truth: Truth | None = None
    aligned: Similarity | None = None
    notes: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """The length unit; empty where nothing says it."""
        for source in (self.scene, self.truth, self.capture):
            if source is not None:
                return source.length_unit
        return self.record.length_unit

    @property
    def shown(self) -> Scene | None:
        """The scene in the frame of the truth, where there is one."""
        if self.scene is None or self.aligned is None:
            return self.scene
        return _moved(self.scene, self.aligned)


Truths = dict[Path, Truth | None]


def read_contents(folder: Path, truths: Truths, with_capture: bool = True) -> RunContents:
    """Read a run folder.

    truths: those read before, by the folder of the photographs, which are not read again. with_capture: also the
    photographs' capture.json, and the photographs for their size.
    """
    notes: list[str] = []
    record = _attempt(lambda: RunRecord.read(folder), notes) or RunRecord(folder)
    scene = _attempt(lambda: _scene(folder), notes, "The cameras and points cannot be read: ")
    place = record.capture
    truth = capture = aligned = None
    if place is not None and place.is_dir():
        if place not in truths:
            truths[place] = _attempt(lambda: load_truth(place), notes)
        truth = truths[place]
        capture = _attempt(lambda: load_capture(place), notes) if with_capture else None
    elif place is not None:
        notes.append(f"The photographs are not in {place} any more: what needs them or their truth is left out.")
    if scene is not None and truth is not None:
        aligned = evaluate(scene.with_points(scene.points[:0], scene.colors[:0]), truth)[1]  # cameras decide it
        truth = truth if aligned is not None else None
    options, overrides = _text(folder / OPTIONS), _overrides(record)
    return RunContents(record, options, overrides, scene, capture, truth, aligned, tuple(dict.fromkeys(notes)))


def _overrides(record: RunRecord) -> tuple[str, ...]:
    """Empty where neither the record nor the options that Hydra keeps say them."""
    if record.overrides:
        return tuple(f"{key}={value}" for key, value in record.overrides.items())
    import yaml  # noqa: PLC0415 - only reports need it

    try:
        listed = yaml.safe_load(_text(record.folder / OVERRIDES))
    except yaml.YAMLError:
        listed = None
    return tuple(map(str, listed)) if isinstance(listed, list) else ()


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


def _scene(folder: Path) -> Scene | None:
    """With points and observations, or points alone where an old run has no tracks.npz."""
    if not (folder / CAMERAS).is_file():
        return None
    cameras = read_cameras(folder / CAMERAS)
    if (folder / TRACKS).is_file() and bool(cameras.views.registered.any()):
        return read_run(folder)
    points = folder / "points.ply"
    return cameras.with_points(*load_points(points)) if points.is_file() else cameras


def _moved(scene: Scene, change: Similarity) -> Scene:
    known, covariance = scene.assessment, scene.assessment.center_covariance
    moved = Assessment() if covariance is None else replace(known, center_covariance=_turned(covariance, change))
    pose = Rigid(change.apply_to_rotation(scene.views.rotation), change.apply(scene.views.center))
    return replace(scene, views=replace(scene.views, pose=pose), points=change.apply(scene.points), assessment=moved)


def _turned(covariance: Float[Tensor, "k 3 3"], change: Similarity) -> Float[Tensor, "k 3 3"]:
    return change.scale**2 * change.rotation @ covariance @ change.rotation.mT
