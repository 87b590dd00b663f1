"""SIFT keypoints with RootSIFT descriptors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchrefrac.checks import Range, require_ranges
from torchrefrac.features.reduced import colors_at, distance_to_unused, nearest_pixels, reduced, reduced_mask
from torchrefrac.files.photographs import read_color
from torchrefrac.numerics import equal_before

PIXELS_A_KEYPOINT = 1000  # with fewer keypoints than one for as many pixels an image is searched for fainter ones,
ENOUGH = 300  # unless it has as many
FAINTEST = 0.125  # share of the contrast threshold that is gone down to
PREFERRED = 8.0
"""Diameter of keypoints, pixels, that are taken first where the largest are wanted. In photographs of a shore from the
air, at 5800 keypoints, any larger size has hardly more matches, and the strongest contrast 45 % fewer."""
ORIENTATIONS = 2
"""The most of one place, where the largest are wanted: others match more often than further ones would."""
CROWDED = 600.0
"""Pixels for each keypoint that is wanted, from which on these are a small share of all that there are."""
ALL = slice(None)
REACH = 2.5  # diameters; three standard deviations of the widest blur that a keypoint is found in

RANGES = {
    "max_pixels": Range(at_least=1.0, at_most=1e9),
    "max_features": Range(at_least=1, at_most=10_000_000),
    "octave_layers": Range(at_least=1, at_most=16),
    "contrast_threshold": Range(at_least=0.0, at_most=1.0),
    "edge_threshold": Range(at_least=1.0, at_most=1e6),
}


@dataclass(frozen=True)
class SiftOptions:
    """OpenCV's SIFT parameters; max_features: by `choice`.

    contrast_threshold: halved, and again, for an image in which hardly anything comes up to it. max_pixels: larger
    images are reduced to as many. choice: of more keypoints than are wanted the "strongest", of the highest contrast,
    whose places are the most exact, or the "largest", however faint, which are found again more often: in real
    photographs at a distance these have nearly twice as many matches. "auto": see `for_images`.
    """

    max_features: int = 8192
    octave_layers: int = 3
    contrast_threshold: float = 0.04
    edge_threshold: float = 10.0
    max_pixels: float = 10e6
    choice: Literal["auto", "strongest", "largest"] = "auto"
    method: Literal["sift"] = "sift"

    def __post_init__(self) -> None:
        require_ranges(self, RANGES)

    def for_images(self, pixels: float) -> "SiftOptions":
        """With the choice made, for images of so many pixels: the largest, where these are many for each keypoint that
        is wanted. Then there are far more keypoints than are wanted, of which the strongest are the smallest and finest
        that a photograph shows, and hardly any is among those of the next one, too. All images must have one choice."""
        if self.choice != "auto":
            return self
        crowded = min(pixels, self.max_pixels) > CROWDED * self.max_features
        return replace(self, choice="largest" if crowded else "strongest")


@dataclass(frozen=True)
class Features:
    """Keypoints of one image, with descriptors, RGB colours, and how large their errors are expected to be, relative to
    those in images that were not reduced.

    descriptors: of unit length, or histograms of gradients as SIFT counts them, which take a quarter of the memory (see
    `unit`).
    """

    pixels: Float[Tensor, "k 2"]
    descriptors: Float[Tensor, "k d"] | UInt8[Tensor, "k d"]
    colors: UInt8[Tensor, "k 3"]
    noise: Float[Tensor, " k"]

    def __len__(self) -> int:
        return len(self.pixels)

    def unit(self, rows: Int[Tensor, "*some"] | slice = ALL) -> Float[Tensor, "*some d"]:
        """Descriptors of some keypoints, by default of all, of unit length: of histograms the roots of their shares
        (RootSIFT; Arandjelovic & Zisserman, CVPR 2012)."""
        some = self.descriptors[rows]
        if some.is_floating_point():
            return some
        counts = some.float()
        total = counts.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(counts.dtype).tiny)
        return (counts / total).sqrt()


def extract_sift(path: Path, options: SiftOptions, used: Bool[Tensor, "height width"] | None = None) -> Features:
    """Detect and describe the keypoints of the image file at `path`.

    used: which of its pixels may be used, by default all; no keypoint is so near to the others that it would see them.

    `enable_precise_upscale` is on: without it OpenCV places keypoints a quarter of a pixel off. OpenCV's pixel (0, 0)
    is (0.5, 0.5) here.
    """
    image, (across, down) = reduced(read_color(path), options.max_pixels)
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    options = options.for_images(grey.size)
    allowed = None if used is None else reduced_mask(used, *grey.shape)
    share = 1.0 if allowed is None else float(allowed.mean())
    enough = min(share * grey.size / PIXELS_A_KEYPOINT, ENOUGH, options.max_features)
    if options.choice == "largest":
        keypoints = _largest(_detect(grey, options, FAINTEST, allowed), options)
    else:
        keypoints = _strongest(_detect(grey, options, 1.0, allowed), options, enough)
        if len(keypoints) < enough:
            keypoints = _strongest(_detect(grey, options, FAINTEST, allowed), options, enough)
    keypoints, descriptors = _sift(options, FAINTEST).compute(grey, keypoints)
    if not len(keypoints):
        descriptors = np.zeros((0, 128), dtype=np.float32)
    pixels = torch.from_numpy(_positions(keypoints)) + 0.5
    return Features(
        pixels=pixels * torch.tensor((across, down), dtype=torch.float64),
        descriptors=torch.from_numpy(descriptors.astype(np.uint8)),  # whole numbers up to 255
        colors=colors_at(image, pixels),
        noise=torch.full((len(keypoints),), math.sqrt(across * down), dtype=torch.float64),
    )


def _sift(options: SiftOptions, faintest: float) -> cv2.SIFT:
    return cv2.SIFT.create(
        nOctaveLayers=options.octave_layers,
        contrastThreshold=faintest * options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        enable_precise_upscale=True,
    )


def _detect(
    grey: UInt8[np.ndarray, "height width"],
    options: SiftOptions,
    faintest: float,
    used: UInt8[np.ndarray, "height width"] | None,
) -> Sequence[cv2.KeyPoint]:
    """All keypoints whose contrast comes up to a share of the threshold, and whose place does not depend on what may
    not be used."""
    found = _sift(options, faintest).detect(grey, None)  # type: ignore[call-overload]
    if used is None:
        return found
    column, row = nearest_pixels(_positions(found), *grey.shape)
    far = zip(found, distance_to_unused(used)[row, column].tolist(), strict=True)
    return [keypoint for keypoint, away in far if away > REACH * keypoint.size]


def _strongest(keypoints: Sequence[cv2.KeyPoint], options: SiftOptions, enough: float) -> list[cv2.KeyPoint]:
    """Those of the highest contrast that come up to the threshold, which is lowered for an image that has not `enough`
    otherwise."""
    contrast = options.octave_layers * np.array([keypoint.response for keypoint in keypoints])
    threshold = options.contrast_threshold
    while (distinct := contrast >= threshold).sum() < enough and threshold > FAINTEST * options.contrast_threshold:
        threshold /= 2.0
    rows = distinct.nonzero()[0]
    rows = rows[np.argsort(-contrast[rows], kind="stable")]
    return [keypoints[row] for row in rows[: options.max_features]]


def _largest(keypoints: Sequence[cv2.KeyPoint], options: SiftOptions) -> list[cv2.KeyPoint]:
    """Those whose diameter is nearest to PREFERRED, as a factor, and of these the ones of the highest contrast.

    Large keypoints are found again more often: noise of pixels is averaged over them, so that what it makes of their
    contrast falls with their size, and faint ones will do. Beyond PREFERRED that gains little, but their places become
    less certain.
    """
    if not keypoints:
        return []
    size = np.array([keypoint.size for keypoint in keypoints])
    contrast = np.array([keypoint.response for keypoint in keypoints])
    order = np.lexsort((-contrast, -np.minimum(size, PREFERRED**2 / size)))
    place = torch.from_numpy(np.column_stack((_positions(keypoints), size))[order])
    rows = order[(equal_before(place) < ORIENTATIONS).numpy()]
    return [keypoints[row] for row in rows[: options.max_features]]


def _positions(keypoints: Sequence[cv2.KeyPoint]) -> Float[np.ndarray, "k 2"]:
    return np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2)
