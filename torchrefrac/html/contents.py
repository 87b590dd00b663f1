"""What lies in a run folder, read as far as it can be."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.files.cameras import CAMERAS, load_points, read_cameras
from torchrefrac.files.capture import load_capture
from torchrefrac.files.run import RunRecord
from torchrefrac.files.tracks import TRACKS, read_run
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Similarity
from torchrefrac.scene import Capture, Scene, Truth
from torchrefrac.scene.wording import OF_WATER, Wording, wording, wording_of
from torchrefrac.sfm.frame import transformed

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
        sources = (self.scene, self.truth, self.capture, self.record)
        return next(source.length_unit for source in sources if source is not None)

    @property
    def words(self) -> Wording:
        """What is called how, by what was looked through; in the frame of the truth, where there is one."""
        return self._wording(self.aligned is not None)

    @property
    def own_words(self) -> Wording:
        """The same in the frame of the run, in which its maps are."""
        return self._wording(upright=False)

    def _wording(self, upright: bool) -> Wording:
        if self.scene is not None:
            scene = replace(self.scene, capture=self.capture)
            return wording_of(scene, self.record.metrics, upright or self._knows_gravity)
        if self.capture is not None:
            return wording(self.capture.interfaces.kinds[0], self._knows_gravity)
        return OF_WATER

    @property
    def _knows_gravity(self) -> bool:
        return self.capture is not None and self.capture.has_gravity

    @property
    def shown(self) -> Scene | None:
        """The scene in the frame of the truth, where there is one."""
        scene, change = self.scene, self.aligned
        if scene is None or change is None:
            return scene
        known = scene.assessment.center_covariance
        turned = None if known is None else change.scale**2 * change.rotation @ known @ change.rotation.mT
        return replace(transformed(scene, change), assessment=replace(scene.assessment, center_covariance=turned))


def read_contents(folder: Path, truths: dict[Path, Truth | None], with_capture: bool = True) -> RunContents:
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
