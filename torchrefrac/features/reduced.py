"""Photographs as keypoints are looked for in: no larger than is wanted, and where keypoints lie in them."""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor


def reduced(
    image: UInt8[np.ndarray, "height width 3"], max_pixels: float
) -> tuple[UInt8[np.ndarray, "rows columns 3"], tuple[float, float]]:
    """The image, made smaller where it has more pixels, and the width and height of what a pixel of it covers."""
    height, width = image.shape[:2]
    share = math.sqrt(max_pixels / (width * height))
    if share >= 1.0:
        return image, (1.0, 1.0)
    columns, rows = max(round(share * width), 1), max(round(share * height), 1)
    smaller = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    return smaller, (width / columns, height / rows)


def reduced_mask(used: Bool[Tensor, "height width"], rows: int, columns: int) -> UInt8[np.ndarray, "rows columns"]:
    """Which pixels of the reduced image show only pixels that may be used."""
    if used.shape == (rows, columns):
        return used.byte().numpy()
    share = cv2.resize(used.float().numpy(), (columns, rows), interpolation=cv2.INTER_AREA)
    return (share > 1.0 - 1e-6).astype(np.uint8)


def distance_to_unused(used: UInt8[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """How far each pixel is from the next one that may not be used, in pixels; 0 for those."""
    return cv2.distanceTransform(used, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def nearest_pixels(
    positions: Float[np.ndarray, "k 2"], rows: int, columns: int
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Column and row of each position, whose origin is the centre of the first pixel."""
    column, row = np.rint(positions).astype(int).T
    return column.clip(0, columns - 1), row.clip(0, rows - 1)


def colors_at(image: UInt8[np.ndarray, "rows columns 3"], pixels: Float[Tensor, "k 2"]) -> UInt8[Tensor, "k 3"]:
    """RGB of a BGR image at pixels, of which the centre of the first is (0.5, 0.5)."""
    column, row = nearest_pixels(pixels.numpy() - 0.5, *image.shape[:2])
    return torch.from_numpy(np.ascontiguousarray(image[row, column, ::-1]))
