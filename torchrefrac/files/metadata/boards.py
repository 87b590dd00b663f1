"""Flat boards and tags in photographs: where their corners are seen."""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
from jaxtyping import Float32, Int

from torchrefrac.files.metadata.tag_corners import fitted_corners
from torchrefrac.files.photographs import read_grey
from torchrefrac.scene.capture import CaptureError

MARKER = 0.7  # side of a marker in units of its square, where nobody says it
BOARD = "board"  # the name of the one board that there is
FAMILY = "tag"  # how names of families of AprilTags begin


@dataclass(frozen=True, eq=False)
class Sighting:
    """A board or tag in a photograph by its name; of each corner that is seen its number, its place in the plane of the
    board (z = 0, in the unit of the sides) and its pixel as OpenCV counts them."""

    name: str
    number: Int[np.ndarray, " n"]
    place: Float32[np.ndarray, "n 3"]
    pixels: Float32[np.ndarray, "n 2"]


class Sight(NamedTuple):
    """The boards and tags of a photograph; twice: names of those that it shows more than once, so that nobody knows
    which is which."""

    seen: list[Sighting]
    twice: tuple[str, ...] = ()

    @property
    def certain(self) -> list[Sighting]:
        """Those that it shows once."""
        return [one for one in self.seen if one.name not in self.twice]


class Pattern(Protocol):
    """What is looked for."""

    def find(self, path: Path) -> Sight:
        """What a photograph shows."""
        ...


@dataclass(frozen=True)
class Charuco:
    """A chessboard with markers in its white squares: columns and rows of squares, sides of squares and markers.

    Raises CaptureError for a dictionary that OpenCV does not know, or that has too few markers.
    """

    columns: int
    rows: int
    square: float
    marker: float | None = None
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        known, wanted = len(_dictionary(self.dictionary).bytesList), self.columns * self.rows // 2
        if wanted > known:
            board = f"a board of {self.columns} x {self.rows} squares has {wanted}"
            raise CaptureError(f"dictionary {self.dictionary} has {known} markers, but {board}")

    @cached_property
    def _board(self) -> Any:
        side = MARKER * self.square if self.marker is None else self.marker
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, side, _dictionary(self.dictionary))

    def find(self, path: Path) -> Sight:
        """Corners between markers that are seen once; the board counts as seen twice where several markers are."""
        grey, detector = read_grey(path), cv2.aruco.CharucoDetector(self._board)
        _, _, corners, numbers = detector.detectBoard(grey)
        markers = _numbers(numbers)
        known, counts = np.unique(markers, return_counts=True)
        once = np.isin(markers, known[counts == 1])
        twice = (BOARD,) if (counts > 1).sum() > 1 else ()
        if not once.any():
            return Sight([], twice)
        kept: Any = [corner for corner, is_alone in zip(corners, once, strict=True) if is_alone]
        pixels, numbers, _, _ = detector.detectBoard(grey, markerCorners=kept, markerIds=markers[once].astype(np.int32))
        found = _numbers(numbers)
        places = np.asarray(self._board.getChessboardCorners(), dtype=np.float32)[found]
        return Sight([Sighting(BOARD, found, places, _pixels(pixels))] if len(found) else [], twice)


@dataclass(frozen=True)
class Chessboard:
    """Columns and rows of inner corners, and the side of a square."""

    columns: int
    rows: int
    square: float

    @property
    def looks_the_same_turned(self) -> bool:
        """Whether nobody can tell it from the same board upside down."""
        return (self.columns + self.rows) % 2 == 0

    def find(self, path: Path) -> Sight:
        """All corners or none. The board counts as seen twice where there is another one outside it."""
        grey = read_grey(path)
        pixels = self._corners(grey, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
        if pixels is None:
            return Sight([])
        number = np.arange(self.columns * self.rows)
        place = np.zeros((len(number), 3), dtype=np.float32)
        place[:, :2] = self.square * np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2)
        rest = cv2.fillConvexPoly(grey.copy(), cv2.convexHull(pixels).round().astype(np.int32), 127)
        twice = () if self._corners(rest, 0) is None else (BOARD,)
        return Sight([Sighting(BOARD, number, place, pixels)], twice)

    def _corners(self, grey: cv2.typing.MatLike, flags: int) -> Float32[np.ndarray, "n 2"] | None:
        found, corners = cv2.findChessboardCornersSB(grey, (self.columns, self.rows), flags=flags)
        return _pixels(corners) if found else None


@dataclass(frozen=True)
class Tags:
    """Square tags, each with a number of its own: their family, such as tag36h11, or dictionary, such as DICT_6X6_250;
    and the side of their black square. Raises CaptureError for a family that OpenCV does not know."""

    family: str
    side: float

    def __post_init__(self) -> None:
        _dictionary(self.family)

    def find(self, path: Path) -> Sight:
        """Tags by their numbers, four corners each: clockwise from the first of the drawing."""
        grey, parameters = read_grey(path), cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        corners, numbers, _ = cv2.aruco.ArucoDetector(_dictionary(self.family), parameters).detectMarkers(grey)
        names = [f"tag {number}" for number in _numbers(numbers).tolist()]
        if not names:
            return Sight([])
        place = np.array(((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)), dtype=np.float32) * np.float32(self.side)
        pixels = fitted_corners(grey, np.array(corners, dtype=float).reshape(-1, 4, 2)).astype(np.float32)
        seen = [Sighting(name, np.arange(4), place, four) for name, four in zip(names, pixels, strict=True)]
        return Sight(seen, tuple(name for name, count in Counter(names).items() if count > 1))


def _dictionary(name: str) -> Any:
    """By OpenCV's name, or that of a family of AprilTags."""
    full = name.replace(FAMILY, "DICT_APRILTAG_", 1) if name.startswith(FAMILY) else name
    number = getattr(cv2.aruco, full, None) if full.startswith("DICT_") else None
    if number is None:
        known = ", ".join(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_4X4")))
        raise CaptureError(f"dictionary {name!r} is none of OpenCV's, such as {known}, or tag36h11")
    return cv2.aruco.getPredefinedDictionary(number)


def _numbers(numbers: cv2.typing.MatLike | None) -> Int[np.ndarray, " n"]:
    """Those that OpenCV found: None where it found none."""
    return np.asarray([] if numbers is None else numbers, dtype=int).ravel()


def _pixels(corners: cv2.typing.MatLike) -> Float32[np.ndarray, "n 2"]:
    return np.asarray(corners, dtype=np.float32).reshape(-1, 2)
