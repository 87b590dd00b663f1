"""Keypoints and matches that other programs made: a COLMAP database, or the two HDF5 files of hloc."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.files.colmap.database import read_database
from torchrefrac.files.hloc import read_hloc
from torchrefrac.scene import CaptureError

DATABASE, HDF5 = (".db",), (".h5", ".hdf5")
OUTSIDE = 1.0
"""Pixels beyond the edge of an image that a keypoint may lie, as detectors extrapolate."""


class Correspondences(NamedTuple):
    """Keypoints of images, of which the centre of the first pixel is (0.5, 0.5), none of those that the file lacks; and
    for pairs of images, the first below the second, which keypoints match."""

    pixels: list[Float[Tensor, "k 2"]]
    matches: dict[tuple[int, int], Int[Tensor, "n 2"]]
    missing: list[str]


def read_correspondences(
    path: Path, matches: Path | None, names: Sequence[str], sizes: Sequence[tuple[int, int]]
) -> Correspondences:
    """What the files say of the images `names`, whose widths and heights are `sizes` in pixels; of others nothing is
    read.

    path: a COLMAP database, or the keypoints of hloc, whose matches are in the file `matches`. Raises CaptureError, of
    one sentence that names the file, where it is none of these, has none of the images, has keypoints outside an image
    or matches of keypoints that it lacks, and where what reads HDF5 is not installed.
    """
    pixels, pairs = _read(path, matches)
    if not pixels.keys() & set(names):
        raise CaptureError(
            f"{path} has keypoints of none of the images here: {', '.join(names[:3])}, ...; in the file are "
            f"{', '.join(list(pixels)[:3]) or 'none at all'}"
        )
    index = {name: i for i, name in enumerate(names)}
    found = {
        name: _inside(pixels[name], sizes[image], f"{path}: a keypoint of {name}")
        for name, image in index.items()
        if name in pixels
    }
    joined: dict[tuple[int, int], Int[Tensor, "n 2"]] = {}
    for (first, second), rows in pairs.items():
        if first not in index or second not in index:
            continue
        where = f"{matches or path}: a match of {first} and {second}"
        counts = [len(found[name]) if name in found else 0 for name in (first, second)]
        if len(rows) and not ((rows >= 0).all() and (rows < counts).all()):
            raise CaptureError(f"{where} is of a keypoint that is not there; they have {counts[0]} and {counts[1]}")
        i, j = index[first], index[second]
        ordered = rows if i < j else rows[:, ::-1]
        joined[min(i, j), max(i, j)] = torch.from_numpy(ordered[np.argsort(ordered[:, 0], kind="stable")])
    if not joined:
        raise CaptureError(f"{matches or path} has no matches of two of the images here; match them there first")
    none = torch.zeros(0, 2, dtype=torch.float64)
    missing = [name for name in names if name not in found]
    return Correspondences([found.get(name, none) for name in names], dict(sorted(joined.items())), missing)


def _read(
    path: Path, matches: Path | None
) -> tuple[Mapping[str, Float[np.ndarray, "k 2"]], Mapping[tuple[str, str], Int[np.ndarray, "n 2"]]]:
    for file in (path, matches):
        if file is not None and not file.is_file():
            raise CaptureError(f"{file} is no file, but must be one of keypoints and matches")
    if path.suffix.lower() in DATABASE:
        return read_database(path)
    if path.suffix.lower() not in HDF5:
        endings = ", ".join((*DATABASE, *HDF5))
        raise CaptureError(f"{path} must be a COLMAP database or keypoints of hloc, whose names end in {endings}")
    if matches is None:
        raise CaptureError(f"{path} has keypoints of hloc alone; name the file of their matches as features.matches")
    return read_hloc(path, matches)


def _inside(pixels: Float[np.ndarray, "k 2"], size: tuple[int, int], where: str) -> Float[Tensor, "k 2"]:
    outside = ~((pixels >= -OUTSIDE) & (pixels <= np.array(size) + OUTSIDE)).all(axis=1)
    if outside.any():
        x, y = pixels[outside][0]
        raise CaptureError(
            f"{where} lies at ({x:g}, {y:g}), outside an image of {size[0]}x{size[1]} pixels; were they found in "
            "photographs of another size?"
        )
    return torch.from_numpy(pixels)
