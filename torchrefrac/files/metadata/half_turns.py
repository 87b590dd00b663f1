"""Photographs that were taken past straight down, and how their pixels are stored.

A gimbal that has gone past straight down says that it is turned over: roll 180, yaw the other way round. Most firmwares
store the pixels as the sensor had them, which fits; some turn them upright by half a turn and do not say so. Neighbours
that show the same ground tell which.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from torchrefrac.files.metadata.photograph import Photograph

LONG_SIDE = 800  # of what is compared, px
FEATURES, RATIO = 1500, 0.8  # of ORB; a match must be so much better than the second best
FEWEST = 20  # matches that agree on a turn
NEIGHBOURS = 4  # that are looked at, the nearest in order first
DOUBT_DEG = 60.0  # by which a turn may be off from what was expected: slopes and obliqueness turn images too


def with_right_halves(photographs: Sequence[Photograph]) -> tuple[list[Photograph], list[str]]:
    """The photographs, those past straight down with the gravity of their pixels as stored; and sentences on them."""
    right, notes = list(photographs), []
    for i, one in enumerate(photographs):
        if not one.is_past_nadir or one.attitude is None:
            continue
        found = _is_half_turned(i, photographs)
        if found:
            right[i] = replace(one, attitude=one.attitude.half_turned)
            notes.append(f"{one.path.name}: taken past straight down and stored upright, as its neighbours show")
        elif found is None:
            notes.append(f"{one.path.name}: taken past straight down; no neighbour shows which way up it is stored")
    return right, notes


def _is_half_turned(row: int, photographs: Sequence[Photograph]) -> bool | None:
    """Whether its pixels are turned by half a turn against what its gimbal says; None where nobody can tell."""
    own = photographs[row]
    others = [other for other in photographs if not other.is_past_nadir and other.body == own.body]
    order = {id(other): abs(i - row) for i, other in enumerate(photographs)}
    for other in sorted(others, key=lambda one: order[id(one)])[:NEIGHBOURS]:
        expected, seen = _expected_turn(own, other), _turn(own, other)
        if expected is not None and seen is not None:
            off = abs((seen - expected + 180.0) % 360.0 - 180.0)
            if min(off, 180.0 - off) < DOUBT_DEG:
                return off > 90.0
    return None


def _expected_turn(first: Photograph, second: Photograph) -> float | None:
    """By how many degrees, clockwise, directions on the ground turn from one image to the other."""
    if first.attitude is None or second.attitude is None:
        return None
    if first.attitude.heading_deg is None or second.attitude.heading_deg is None:
        return None
    return first.attitude.heading_deg - second.attitude.heading_deg


def _turn(first: Photograph, second: Photograph) -> float | None:
    """The same, as matches of their pixels show it; None where too few agree."""
    (one, there), (other, here) = (_features(photograph) for photograph in (first, second))
    if min(len(one), len(other)) < FEWEST:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(there, here, k=2)
    clear = [best for best, second_best in pairs if best.distance < RATIO * second_best.distance]
    if len(clear) < FEWEST:
        return None
    source = np.array([one[match.queryIdx].pt for match in clear])
    target = np.array([other[match.trainIdx].pt for match in clear])
    found: Any = cv2.estimateAffinePartial2D(source, target, ransacReprojThreshold=0.02 * LONG_SIDE)
    similarity, agrees = found
    if similarity is None or int(agrees.sum()) < FEWEST:
        return None
    return math.degrees(math.atan2(similarity[1, 0], similarity[0, 0]))


def _features(photograph: Photograph) -> tuple[Any, Any]:
    """Keypoints and descriptors."""
    grey: Any = cv2.imread(str(photograph.path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    scale = LONG_SIDE / max(grey.shape)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else grey
    return cv2.ORB.create(FEATURES).detectAndCompute(small, None)
