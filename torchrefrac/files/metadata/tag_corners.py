"""Corners of dark squares to a tenth of a pixel: where straight lines along their edges meet.

Looking for a corner itself draws it inwards by a quarter of a pixel, as blur makes it round; edges stay where they are.
"""

import cv2
import numpy as np
from jaxtyping import Float, Shaped

ROUNDS = 3  # of looking again around the lines that were found
SHARES = np.linspace(0.1, 0.9, 25)  # of a side, where it is crossed
STEPS = np.linspace(-1.0, 1.0, 25)  # of a crossing, from inside to outside
REACH, FEWEST, MOST = 0.08, 1.5, 4.0  # of a crossing: in sides (the dark border is an eighth or more), px


def fitted_corners(
    grey: Shaped[np.ndarray, "height width"], corners: Float[np.ndarray, "m 4 2"]
) -> Float[np.ndarray, "m 4 2"]:
    """Corners of squares that are dark inside, clockwise as the image shows them, from such within a pixel or two."""
    for _ in range(ROUNDS):
        along = np.roll(corners, -1, axis=1) - corners
        side = np.linalg.norm(along, axis=-1, keepdims=True)
        outwards = np.stack((along[..., 1], -along[..., 0]), axis=-1) / side
        first, last = _offsets(grey, corners, along, outwards, (REACH * side[..., 0]).clip(FEWEST, MOST))
        start = corners + first[..., None] * outwards
        direction = along + (last - first)[..., None] * outwards
        corners = _meeting(np.roll(start, 1, axis=1), np.roll(direction, 1, axis=1), start, direction)
    return corners


def _offsets(
    grey: Shaped[np.ndarray, "height width"],
    start: Float[np.ndarray, "m 4 2"],
    along: Float[np.ndarray, "m 4 2"],
    outwards: Float[np.ndarray, "m 4 2"],
    reach: Float[np.ndarray, "m 4"],
) -> tuple[Float[np.ndarray, "m 4"], Float[np.ndarray, "m 4"]]:
    """By how much an edge lies farther out than a side does at its two ends: a line through the centroids of what grows
    brighter outwards, weighted by how much that is."""
    middle = start[:, :, None] + SHARES[:, None] * along[:, :, None]
    crossing = (reach[..., None] * STEPS)[:, :, None, :, None] * outwards[:, :, None, None]
    x, y = np.moveaxis(middle[:, :, :, None] + crossing, -1, 0).astype(np.float32)
    width = len(STEPS)
    seen = cv2.remap(
        grey, x.reshape(-1, width), y.reshape(-1, width), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    brighter = np.diff(seen.astype(float).reshape(x.shape), axis=-1).clip(min=0.0)
    weight = brighter.sum(axis=-1) + 1e-9
    off = reach[..., None] * (brighter @ (0.5 * (STEPS[1:] + STEPS[:-1]))) / weight
    mean_share, mean_off = (((weight * part).sum(axis=-1) / weight.sum(axis=-1))[..., None] for part in (SHARES, off))
    around = SHARES - mean_share
    slope = (weight * around * (off - mean_off)).sum(axis=-1) / (weight * around**2).sum(axis=-1)
    at_start = mean_off[..., 0] - slope * mean_share[..., 0]
    return at_start, at_start + slope


def _meeting(
    start: Float[np.ndarray, "*batch 2"],
    direction: Float[np.ndarray, "*batch 2"],
    other_start: Float[np.ndarray, "*batch 2"],
    other_direction: Float[np.ndarray, "*batch 2"],
) -> Float[np.ndarray, "*batch 2"]:
    """Where two lines meet."""
    apart = other_start - start
    share = _cross(apart, other_direction) / _cross(direction, other_direction)
    return start + share[..., None] * direction


def _cross(a: Float[np.ndarray, "*batch 2"], b: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
