"""SIFT keypoints with RootSIFT descriptors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchrefrac.checks import Range, require_ranges
from torchrefrac.files.photographs import read_color

PIXELS_A_KEYPOINT = 1000  # with fewer keypoints than one for as many pixels an image is searched for fainter ones,
ENOUGH = 300  # unless it has as many
FAINTEST = 0.125  # share of the contrast threshold that is gone down to
FAINTEST_LARGE = 0.25  # the same for large keypoints of images that have more than enough
SMALLEST = 1.8  # diameter of the smallest keypoints, pixels
REACH = 2.5  # diameters; three standard deviations of the widest blur that a keypoint is found in

RANGES = {
    "max_features": Range(at_least=1, at_most=10_000_000),
    "octave_layers": Range(at_least=1, at_most=16),
    "contrast_threshold": Range(at_least=0.0, at_most=1.0),
    "edge_threshold": Range(at_least=1.0, at_most=1e6),
}


@dataclass(frozen=True)
class SiftOptions:
    """OpenCV's SIFT parameters; max_features: the largest, and then also fainter ones among these.

    contrast_threshold: halved, and again, for an image in which hardly anything comes up to it.
    """

    max_features: int = 8192
    octave_layers: int = 3
    contrast_threshold: float = 0.04
    edge_threshold: float = 10.0

    def __post_init__(self) -> None:
        require_ranges(self, RANGES)


@dataclass(frozen=True)
class Features:
    """Keypoints of one image, with unit descriptors, RGB colours and their diameters, pixels."""

    pixels: Float[Tensor, "k 2"]
    descriptors: Float[Tensor, "k 128"]
    colors: UInt8[Tensor, "k 3"]
    size: Float[Tensor, " k"]

    def __len__(self) -> int:
        return len(self.pixels)


def extract_sift(path: Path, options: SiftOptions, used: Bool[Tensor, "height width"] | None = None) -> Features:
    """Detect and describe the keypoints of the image file at `path`.

    used: which of its pixels may be used, by default all; no keypoint is so near to the others that it would see them.

    `enable_precise_upscale` is on: without it OpenCV places keypoints a quarter of a pixel off. Descriptors are
    RootSIFT (Arandjelovic & Zisserman, CVPR 2012). OpenCV's pixel (0, 0) is (0.5, 0.5) here.
    """
    image = read_color(path)
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    share = 1.0 if used is None else float(used.double().mean())
    enough = min(share * grey.size / PIXELS_A_KEYPOINT, ENOUGH, options.max_features)
    sift = cv2.SIFT.create(
        nOctaveLayers=options.octave_layers,
        contrastThreshold=FAINTEST * options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        enable_precise_upscale=True,
    )
    found = sift.detect(grey, None)
    if used is not None:
        found = _usable(found, used, grey)
    keypoints, descriptors = sift.compute(grey, _distinct(found, options, enough))
    if not len(keypoints):
        descriptors = np.zeros((0, 128), dtype=np.float32)
    column, row = _nearest_pixels(keypoints, grey)
    colors = image[row, column, ::-1]
    return Features(
        pixels=torch.from_numpy(_positions(keypoints)) + 0.5,
        descriptors=_root_sift(torch.from_numpy(descriptors)),
        colors=torch.from_numpy(np.ascontiguousarray(colors)),
        size=torch.tensor([keypoint.size for keypoint in keypoints], dtype=torch.float64),
    )


def _distinct(keypoints: Sequence[cv2.KeyPoint], options: SiftOptions, enough: float) -> list[cv2.KeyPoint]:
    """Those that come up to the threshold, which is lowered for an image that has not `enough` otherwise.

    Where these are more than are wanted, the largest, which are found again most often, and among them fainter ones:
    noise of pixels is averaged over a keypoint, so that what it makes of them falls with their size.
    """
    size = np.array([keypoint.size for keypoint in keypoints])
    contrast = options.octave_layers * np.array([keypoint.response for keypoint in keypoints])
    threshold = options.contrast_threshold
    while (distinct := contrast >= threshold).sum() < enough and threshold > FAINTEST * options.contrast_threshold:
        threshold /= 2.0
    if distinct.sum() > options.max_features:
        distinct = contrast >= threshold * np.maximum(SMALLEST / size, FAINTEST_LARGE)
    rows = distinct.nonzero()[0]
    rows = rows[np.lexsort((-contrast[rows], -size[rows]))]
    return [keypoints[row] for row in rows[: options.max_features]]


def _usable(
    keypoints: Sequence[cv2.KeyPoint], used: Bool[Tensor, "height width"], grey: UInt8[np.ndarray, "height width"]
) -> list[cv2.KeyPoint]:
    """Those whose place does not depend on what may not be used."""
    distance = cv2.distanceTransform(used.byte().numpy(), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    column, row = _nearest_pixels(keypoints, grey)
    far = zip(keypoints, distance[row, column].tolist(), strict=True)
    return [keypoint for keypoint, away in far if away > REACH * keypoint.size]


def _positions(keypoints: Sequence[cv2.KeyPoint]) -> Float[np.ndarray, "k 2"]:
    return np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2)


def _nearest_pixels(
    keypoints: Sequence[cv2.KeyPoint], grey: UInt8[np.ndarray, "height width"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Column and row of each."""
    column, row = np.rint(_positions(keypoints)).astype(int).T
    return column.clip(0, grey.shape[1] - 1), row.clip(0, grey.shape[0] - 1)


def _root_sift(descriptors: Float[Tensor, "k 128"]) -> Float[Tensor, "k 128"]:
    total = descriptors.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(descriptors.dtype).tiny)
    return (descriptors / total).sqrt()
