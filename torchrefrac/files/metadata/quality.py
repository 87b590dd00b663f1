"""Photographs that are of no use: blurred far beyond their neighbours, black, or burnt out."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np

from torchrefrac.parallel import side_by_side

REDUCED = cv2.IMREAD_REDUCED_GRAYSCALE_2 | cv2.IMREAD_IGNORE_ORIENTATION
BLACK, WHITE = 12.0, 250.0  # grey values below or above which nearly all of a useless photograph lies
NEARLY_ALL = 99.0  # percent
NEIGHBOURS = 4  # on either side, in the order of the names
BLURRED = 0.03  # of its neighbours' sharpness: by a spot or a motion of 10 pixels; sharp ones differ by a quarter


class Quality(NamedTuple):
    """sharpness: contrast of the finest details in units of that of coarse ones; dark and bright: grey values that
    nearly all of it is below or above."""

    sharpness: float
    dark: float
    bright: float


def look_at(paths: Sequence[Path]) -> list[Quality]:
    """Of photographs, read at half their size."""
    return side_by_side(_quality, paths)


def sharpness(grey: cv2.typing.MatLike) -> float:
    """What a grey image loses when neighbouring pixels are averaged along rows or columns, in units of its contrast
    between places some ten pixels apart, which no blur takes away. Rows or columns, whichever loses less: what moved in
    one direction is sharp across it."""
    fine = grey.astype(np.float32)
    contrast = float(np.var(cv2.GaussianBlur(fine, (0, 0), 4.0) - cv2.GaussianBlur(fine, (0, 0), 12.0))) + 1.0
    return min(float(np.var(fine - cv2.blur(fine, size))) for size in ((3, 1), (1, 3))) / contrast


def useless(found: Sequence[Quality]) -> list[str]:
    """Why each of a series of photographs is of no use; empty where it is."""
    reasons: list[str] = []
    for i, own in enumerate(found):
        around = [*found[max(i - NEIGHBOURS, 0) : i], *found[i + 1 : i + 1 + NEIGHBOURS]]
        usual = median(other.sharpness for other in around) if around else own.sharpness
        if own.dark <= BLACK:
            reasons.append("black")
        elif own.bright >= WHITE:
            reasons.append("burnt out: nearly all of it is white")
        elif own.sharpness < BLURRED * usual:
            reasons.append(f"blurred: {own.sharpness / usual:.0%} as sharp as its neighbours")
        else:
            reasons.append("")
    return reasons


def _quality(path: Path) -> Quality:
    grey = cv2.imread(str(path), REDUCED)
    if grey is None:
        return Quality(1.0, 255.0, 0.0)  # what cannot be read is told of elsewhere
    dark, bright = np.percentile(grey, (NEARLY_ALL, 100.0 - NEARLY_ALL))
    return Quality(sharpness(grey), float(dark), float(bright))
