"""Flat boards that cameras are calibrated with: where their corners are seen in photographs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from torchrefrac.files.photographs import read_grey
from torchrefrac.scene.capture import CaptureError

MARKER = 0.7  # side of a marker in units of its square, where nobody says it
FEWEST = 8  # corners of a board in a photograph that is used


@dataclass(frozen=True, eq=False)
class Board:
    """A charuco board, or where `markers` is None a chessboard; columns and rows as `torchrefrac calibrate` takes
    them."""

    columns: int
    rows: int
    square: float
    markers: Any = None

    @classmethod
    def charuco(cls, columns: int, rows: int, square: float, marker: float | None, dictionary: str) -> "Board":
        """Raises CaptureError for a dictionary that OpenCV does not know, or that has too few markers."""
        number = getattr(cv2.aruco, dictionary, None) if dictionary.startswith("DICT_") else None
        if number is None:
            known = ", ".join(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_4X4")))
            raise CaptureError(f"dictionary {dictionary!r} is none of OpenCV's, such as {known}")
        words = cv2.aruco.getPredefinedDictionary(number)
        if columns * rows // 2 > len(words.bytesList):
            wanted = f"a board of {columns} x {rows} squares has {columns * rows // 2}"
            raise CaptureError(f"dictionary {dictionary} has {len(words.bytesList)} markers, but {wanted}")
        size = MARKER * square if marker is None else marker
        return cls(columns, rows, square, cv2.aruco.CharucoBoard((columns, rows), square, size, words))

    def find(self, path: Path) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 2"]] | None:
        """Corners on the board, and their pixels as OpenCV counts them; None where there are too few."""
        grey = read_grey(path)
        return self._chessboard(grey) if self.markers is None else self._charuco(grey)

    def _charuco(
        self, grey: cv2.typing.MatLike
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 2"]] | None:
        detector: Any = cv2.aruco.CharucoDetector(self.markers)
        corners, numbers, _, _ = detector.detectBoard(grey)
        if numbers is None or len(numbers) < FEWEST:
            return None
        places = np.asarray(self.markers.getChessboardCorners(), dtype=np.float32)
        return places[np.asarray(numbers, dtype=int).ravel()], corners.reshape(-1, 2).astype(np.float32)

    def _chessboard(
        self, grey: cv2.typing.MatLike
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 2"]] | None:
        size = (self.columns, self.rows)
        found, corners = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
        if not found:
            return None
        grid = np.zeros((self.columns * self.rows, 3), dtype=np.float32)
        grid[:, :2] = self.square * np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2)
        return grid, corners.reshape(-1, 2).astype(np.float32)
