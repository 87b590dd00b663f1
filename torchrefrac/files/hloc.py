"""Keypoints and matches out of the HDF5 files of hloc (Hierarchical-Localization). Needs h5py, of the extra `hloc`."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from torchrefrac.scene import CaptureError

CENTER = 0.5
"""What pixels of hloc, which count from the centre of the first, are less than those here."""
MISSING = "needs h5py, which is not installed: pip install torchrefrac[hloc]"


def read_hloc(
    keypoints: Path, matches: Path
) -> tuple[dict[str, Float[np.ndarray, "k 2"]], dict[tuple[str, str], Int[np.ndarray, "n 2"]]]:
    """Keypoints in pixels (the centre of the first is (0.5, 0.5)) by the names of images, and matches by two names.

    Raises CaptureError for files that are not those of hloc, and where h5py is not installed.
    """
    try:
        h5py: Any = import_module("h5py")
    except ImportError:
        raise CaptureError(f"{keypoints} {MISSING}") from None
    try:
        with h5py.File(keypoints, "r") as file:
            pixels = {
                name: np.asarray(image["keypoints"][()], dtype=np.float64).reshape(-1, 2) + CENTER
                for name, image in _groups(file, "keypoints")
            }
    except (OSError, ValueError) as error:
        raise CaptureError(f"{keypoints} cannot be read as the keypoints of hloc: {error}") from None
    named = {name.replace("/", "-"): name for name in pixels}
    found: dict[tuple[str, str], Int[np.ndarray, "n 2"]] = {}
    try:
        with h5py.File(matches, "r") as file:
            for path, pair in _groups(file, "matches0"):
                first, _, second = path.partition("/")
                partner = np.asarray(pair["matches0"][()]).astype(np.int64).ravel()
                (rows,) = np.nonzero(partner >= 0)
                if first in named and second in named:
                    found[named[first], named[second]] = np.stack((rows, partner[rows]), axis=1)
    except (OSError, ValueError) as error:
        raise CaptureError(f"{matches} cannot be read as the matches of hloc: {error}") from None
    return pixels, found


def _groups(group: Any, wanted: str, path: str = "") -> Iterator[tuple[str, Any]]:
    """The groups that have an array of a name, with their paths: names of images may have slashes."""
    if wanted in group:
        yield path, group
        return
    for name in group:
        if hasattr(group[name], "keys"):
            yield from _groups(group[name], wanted, f"{path}/{name}" if path else name)
