"""Frames of a film that serve as photographs: sharp ones, as far apart as their overlap allows.

OpenCV reads films, and is there already; PyAV would add a second copy of the same decoders for times that frames.csv
has from OpenCV as well.
"""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from torchrefrac.atomic import replacing
from torchrefrac.files.metadata.quality import sharpness
from torchrefrac.recorder import Recorder
from torchrefrac.scene.capture import CaptureError

LOOKS_PER_SECOND = 10.0  # at the film: motion between two looks must be small enough to be followed
LONG_SIDE = 480  # of the frames that are looked at, px
CORNERS, FEWEST_CORNERS = 200, 12  # that are followed from look to look; with fewer the scene has changed
SLACK = 0.25  # of the spacing, by which a frame may be early or late in order to be sharp
QUALITY = 95  # of JPEG


class Look(NamedTuple):
    """A frame by its number, its time, how far the picture has moved since the first (in long sides), and sharpness."""

    number: int
    seconds: float
    moved: float
    sharpness: float


def take_frames(film: Path, folder: Path, overlap: float, most: int, recorder: Recorder) -> list[tuple[Path, Look]]:
    """Write frames of a film into a folder, at most `most`, neighbours with so much of their sides in common.

    Raises CaptureError where the file is no film, or its camera does not move.
    """
    looks = list(_looks(film, recorder))
    chosen = choose(looks, 1.0 - overlap, most)
    if len(chosen) < 2:
        found = f"its camera moves by less than {1.0 - overlap:.0%} of the picture" if looks else "no frame can be read"
        raise CaptureError(f"{film} does not make two photographs: {found}; give another film, or more film.overlap")
    folder.mkdir(parents=True, exist_ok=True)
    return list(_written(film, chosen, folder, recorder))


def write_times(frames: Sequence[tuple[Path, Look]], path: Path) -> None:
    """`frames.csv`: name, number and time of each frame."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("name", "frame", "seconds"))
        writer.writerows((frame.name, look.number, f"{look.seconds:.3f}") for frame, look in frames)


def choose(looks: Sequence[Look], spacing: float, most: int) -> list[Look]:
    """The sharpest around each multiple of the spacing; farther apart where that would be too many."""
    if not looks:
        return []
    spacing = max(spacing, looks[-1].moved / max(most - 1, 1))
    moved = np.array([look.moved for look in looks])
    chosen: dict[int, Look] = {}
    for place in np.arange(0.0, moved[-1] + SLACK * spacing, spacing):
        near = np.flatnonzero(np.abs(moved - place) <= SLACK * spacing)
        rows = near.tolist() or [int(np.abs(moved - place).argmin())]
        best = max((looks[row] for row in rows), key=lambda look: look.sharpness)
        chosen[best.number] = best
    return list(chosen.values())[:most]


def _looks(film: Path, recorder: Recorder) -> Iterator[Look]:
    """Ten times a second."""
    before, moved = None, 0.0
    step, count = _rhythm(film)
    for number, seconds, frame in recorder.track(_frames(film, step), max(count // step, 1), "watching", "look"):
        scale = LONG_SIDE / max(frame.shape[:2])
        small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
        moved += 0.0 if before is None else _motion(before, grey)
        before = grey
        yield Look(number, seconds, moved, sharpness(grey))


def _rhythm(film: Path) -> tuple[int, int]:
    """How many frames lie between two looks, and how many there are."""
    capture = cv2.VideoCapture(str(film))
    rate, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    is_open = capture.isOpened()
    capture.release()
    if not is_open:
        raise CaptureError(f"{film} cannot be read as a film; convert it to MP4, for example with ffmpeg")
    return max(1, round(rate / LOOKS_PER_SECOND)) if 0.0 < rate < 1e5 else 1, max(int(count), 0)


def _frames(film: Path, step: int, wanted: set[int] | None = None) -> Iterator[tuple[int, float, cv2.typing.MatLike]]:
    """Number, time and pixels of every `step`th frame, or of those that are wanted."""
    capture = cv2.VideoCapture(str(film))
    try:
        number = 0
        while capture.grab():
            if number in wanted if wanted is not None else number % step == 0:
                seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                is_read, frame = capture.retrieve()
                if is_read:
                    yield number, seconds, frame
            number += 1
    finally:
        capture.release()


def _motion(before: cv2.typing.MatLike, after: cv2.typing.MatLike) -> float:
    """By how much the picture moved, in long sides; by all of it where nothing can be followed."""
    corners: Any = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 8.0)
    if corners is None or len(corners) < FEWEST_CORNERS:
        return 0.0  # nothing to see: neither moved nor changed, as far as anybody knows
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    paths = (there - corners)[found.ravel() == 1].reshape(-1, 2)
    return 1.0 if len(paths) < FEWEST_CORNERS else _typical(paths) / LONG_SIDE


def _typical(paths: Float[np.ndarray, "n 2"]) -> float:
    return float(np.median(np.linalg.norm(paths, axis=-1)))


def _written(film: Path, chosen: Sequence[Look], folder: Path, recorder: Recorder) -> Iterator[tuple[Path, Look]]:
    looks = {look.number: look for look in chosen}
    frames = _frames(film, 1, set(looks))
    for number, _, frame in recorder.track(frames, len(looks), "taking", "frame"):
        path = folder / f"frame_{number:06d}.jpg"
        _, encoded = cv2.imencode(".jpg", frame, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
        path.write_bytes(encoded.tobytes())
        yield path, looks[number]
