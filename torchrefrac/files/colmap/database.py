"""Keypoints and matches out of a COLMAP database."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped

from torchrefrac.scene import CaptureError

MOST_IMAGES = 2**31 - 1  # of a database; the number of a pair is that of the first times this, and that of the second
COLUMNS = (2, 4, 6)  # of keypoints: x, y; scale and orientation; or an affine shape


def read_database(
    path: Path,
) -> tuple[dict[str, Float[np.ndarray, "k 2"]], dict[tuple[str, str], Int[np.ndarray, "n 2"]]]:
    """Keypoints in pixels (the centre of the first is (0.5, 0.5)) by the names of images, and matches by two names.

    Matches are those before COLMAP verified them by a geometry without refraction, or those after where the database
    has no others. Raises CaptureError for a file that is no such database, or where numbers in it do not fit.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            names: dict[int, str] = dict(database.execute("SELECT image_id, name FROM images"))
            keypoints = database.execute("SELECT image_id, rows, cols, data FROM keypoints").fetchall()
            pairs = database.execute("SELECT pair_id, rows, cols, data FROM matches WHERE rows > 0").fetchall()
            if not pairs:
                verified = "SELECT pair_id, rows, cols, data FROM two_view_geometries WHERE rows > 0"
                pairs = database.execute(verified).fetchall()
    except sqlite3.Error as error:
        raise CaptureError(f"{path} is not a whole COLMAP database: {error}") from None
    pixels: dict[str, Float[np.ndarray, "k 2"]] = {}
    for image, rows, columns, data in keypoints:
        name = _name(names, image, path)
        if columns not in COLUMNS:
            raise CaptureError(f"{path}: keypoints of {name} have {columns} numbers each, but must have 2, 4 or 6")
        pixels[name] = _array(data, rows, columns, "<f4", f"{path}: keypoints of {name}")[:, :2].astype(np.float64)
    matches: dict[tuple[str, str], Int[np.ndarray, "n 2"]] = {}
    for pair, rows, columns, data in pairs:
        first, second = (_name(names, image, path) for image in divmod(pair, MOST_IMAGES))
        where = f"{path}: matches of {first} and {second}"
        if columns != 2:
            raise CaptureError(f"{where} have {columns} numbers each, but must have 2")
        matches[first, second] = _array(data, rows, columns, "<u4", where).astype(np.int64)
    return pixels, matches


def _name(names: dict[int, str], image: int, path: Path) -> str:
    if image not in names:
        raise CaptureError(f"{path} has keypoints or matches of image {image}, but no image of this number")
    return names[image]


def _array(data: bytes | None, rows: int, columns: int, dtype: str, where: str) -> Shaped[np.ndarray, "rows columns"]:
    numbers = data or b""
    if len(numbers) != 4 * rows * columns:
        raise CaptureError(f"{where} take {len(numbers)} bytes, but must take {4 * rows * columns}")
    return np.frombuffer(numbers, dtype=dtype).reshape(rows, columns)
