"""Corners of dark squares to some hundredths of a pixel: where lines along their edges meet.

Looking for a corner itself draws it inwards by a quarter of a pixel, as blur makes it round; edges stay where they are.
They are followed for a short way only, since lenses and water bend what is longer.
"""

import cv2
import numpy as np
from jaxtyping import Float, Shaped

ROUNDS = 3  # of looking again around the lines that were found
NEAREST, FARTHEST = 6.0, 60.0  # px, from the corner and from there, between which an edge is followed
ENDS = 0.1  # of a side, at most, that is left out at either end
SHARES, STEPS = np.linspace(0.0, 1.0, 25), np.linspace(-1.0, 1.0, 25)  # along an edge; across it, from inside
REACH, FEWEST, MOST = 0.08, 1.5, 4.0  # across: in sides (the dark border is an eighth or more), at least and most px


def fitted_corners(
    grey: Shaped[np.ndarray, "height width"], corners: Float[np.ndarray, "m 4 2"]
) -> Float[np.ndarray, "m 4 2"]:
    """Corners of squares that are dark inside, clockwise as the image shows them, from such within a pixel or two."""
    for _ in range(ROUNDS):
        along = np.stack([np.roll(corners, by, axis=1) - corners for by in (-1, 1)], axis=2)
        side = np.linalg.norm(along, axis=-1)
        along = along / side[..., None]
        outwards = np.stack((along[..., 1], -along[..., 0]), axis=-1) * np.array((1.0, -1.0))[:, None]
        start = np.minimum(ENDS * side, NEAREST)
        length = np.minimum((1.0 - ENDS) * side - start, FARTHEST)
        distance = start[..., None] + length[..., None] * SHARES
        off, weight = _edges(grey, corners[:, :, None], along, outwards, distance, (REACH * side).clip(FEWEST, MOST))
        offset, slope = _line(distance, off, weight)
        place, direction = corners[:, :, None] + offset[..., None] * outwards, along + slope[..., None] * outwards
        corners = _meeting(place, direction)
    return corners


def _edges(
    grey: Shaped[np.ndarray, "height width"],
    corner: Float[np.ndarray, "m 4 1 2"],
    along: Float[np.ndarray, "m 4 2 2"],
    outwards: Float[np.ndarray, "m 4 2 2"],
    distance: Float[np.ndarray, "m 4 2 s"],
    reach: Float[np.ndarray, "m 4 2"],
) -> tuple[Float[np.ndarray, "m 4 2 s"], Float[np.ndarray, "m 4 2 s"]]:
    """By how much an edge lies farther out than the sides do, at some distances from their corners: the centroid of
    what grows brighter outwards; and how much that is."""
    foot = corner[..., None, :] + distance[..., None] * along[..., None, :]
    across = (reach[..., None] * STEPS)[..., None, :, None] * outwards[..., None, None, :]
    x, y = np.moveaxis(foot[..., None, :] + across, -1, 0).astype(np.float32)
    x_rows, y_rows = (part.reshape(-1, len(STEPS)) for part in (x, y))
    seen = cv2.remap(grey, x_rows, y_rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    brighter = np.diff(seen.astype(float).reshape(x.shape), axis=-1).clip(min=0.0)
    weight = brighter.sum(axis=-1) + 1e-9
    return reach[..., None] * (brighter @ (0.5 * (STEPS[1:] + STEPS[:-1]))) / weight, weight


def _line(
    x: Float[np.ndarray, "*batch s"], y: Float[np.ndarray, "*batch s"], weight: Float[np.ndarray, "*batch s"]
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
    """Height at 0 and slope of the lines through points, by weighted least squares."""
    share = weight / weight.sum(axis=-1, keepdims=True)
    middle, height = ((share * part).sum(axis=-1) for part in (x, y))
    around = x - middle[..., None]
    slope = (share * around * y).sum(axis=-1) / (share * around**2).sum(axis=-1)
    return height - slope * middle, slope


def _meeting(
    place: Float[np.ndarray, "*batch 2 2"], direction: Float[np.ndarray, "*batch 2 2"]
) -> Float[np.ndarray, "*batch 2"]:
    """Where two lines meet."""
    (first, second), (one, other) = (np.moveaxis(part, -2, 0) for part in (place, direction))
    share = _cross(second - first, other) / _cross(one, other)
    return first + share[..., None] * one


def _cross(a: Float[np.ndarray, "*batch 2"], b: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
