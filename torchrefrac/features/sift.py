"""SIFT keypoints with RootSIFT descriptors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8
from torch import Tensor

from torchrefrac.checks import Range, require_ranges
from torchrefrac.files.photographs import read_color

PIXELS_A_KEYPOINT = 1000  # with fewer keypoints than one for as many pixels an image is searched for fainter ones,
ENOUGH = 300  # unless it has as many
FAINTEST = 0.125  # share of the contrast threshold that is gone down to
REACH = 2.5  # diameters; three standard deviations of the widest blur that a keypoint is found in

RANGES = {
    "max_features": Range(at_least=1, at_most=10_000_000),
    "octave_layers": Range(at_least=1, at_most=16),
    "contrast_threshold": Range(at_least=0.0, at_most=1.0),
    "edge_threshold": Range(at_least=1.0, at_most=1e6),
}


@dataclass(frozen=True)
class SiftOptions:
    """OpenCV's SIFT parameters; max_features: the strongest.

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
    """Keypoints of one image, with unit descriptors and RGB colours."""

    pixels: Float[Tensor, "k 2"]
    descriptors: Float[Tensor, "k 128"]
    colors: UInt8[Tensor, "k 3"]

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
    threshold = options.contrast_threshold
    keypoints, descriptors = _detect(grey, options, threshold, used)
    while len(keypoints) < enough and threshold > FAINTEST * options.contrast_threshold:
        threshold /= 2.0
        keypoints, descriptors = _detect(grey, options, threshold, used)
    column, row = _nearest_pixels(keypoints, grey)
    colors = image[row, column, ::-1]
    return Features(
        pixels=torch.from_numpy(_positions(keypoints)) + 0.5,
        descriptors=_root_sift(torch.from_numpy(descriptors)),
        colors=torch.from_numpy(np.ascontiguousarray(colors)),
    )


def _detect(
    grey: UInt8[np.ndarray, "height width"],
    options: SiftOptions,
    threshold: float,
    used: Bool[Tensor, "height width"] | None,
) -> tuple[Sequence[cv2.KeyPoint], Float32[np.ndarray, "k 128"]]:
    """The strongest keypoints with a contrast above the threshold, and their descriptors."""
    sift = cv2.SIFT.create(
        nfeatures=options.max_features if used is None else 0,
        nOctaveLayers=options.octave_layers,
        contrastThreshold=threshold,
        edgeThreshold=options.edge_threshold,
        enable_precise_upscale=True,
    )
    if used is None:
        keypoints, descriptors = sift.detectAndCompute(grey, None)  # type: ignore[call-overload]
    else:
        keypoints = _usable(sift.detect(grey, None), used, grey)
        keypoints.sort(key=lambda keypoint: -keypoint.response)
        keypoints, descriptors = sift.compute(grey, keypoints[: options.max_features])
    return keypoints, descriptors if len(keypoints) else np.zeros((0, 128), dtype=np.float32)


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
