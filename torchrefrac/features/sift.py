"""SIFT keypoints with RootSIFT descriptors."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchrefrac.checks import Range, require_ranges
from torchrefrac.files.capture import read_color

RANGES = {
    "max_features": Range(at_least=1, at_most=10_000_000),
    "octave_layers": Range(at_least=1, at_most=16),
    "contrast_threshold": Range(at_least=0.0, at_most=1.0),
    "edge_threshold": Range(at_least=1.0, at_most=1e6),
}


@dataclass(frozen=True)
class SiftOptions:
    """OpenCV's SIFT parameters; max_features: the strongest."""

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


def extract_sift(path: Path, options: SiftOptions) -> Features:
    """Detect and describe the keypoints of the image file at `path`.

    `enable_precise_upscale` is on: without it OpenCV places keypoints a quarter of a pixel off. Descriptors are
    RootSIFT (Arandjelovic & Zisserman, CVPR 2012). OpenCV's pixel (0, 0) is (0.5, 0.5) here.
    """
    image = read_color(path)
    sift = cv2.SIFT.create(
        nfeatures=options.max_features,
        nOctaveLayers=options.octave_layers,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        enable_precise_upscale=True,
    )
    keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), None)  # type: ignore[call-overload]
    if not keypoints:
        descriptors = np.zeros((0, 128), dtype=np.float32)
    position = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2)
    column, row = np.rint(position).astype(int).T
    height, width = image.shape[:2]
    colors = image[row.clip(0, height - 1), column.clip(0, width - 1), ::-1]
    return Features(
        pixels=torch.from_numpy(position) + 0.5,
        descriptors=_root_sift(torch.from_numpy(descriptors)),
        colors=torch.from_numpy(np.ascontiguousarray(colors)),
    )


def _root_sift(descriptors: Float[Tensor, "k 128"]) -> Float[Tensor, "k 128"]:
    total = descriptors.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(descriptors.dtype).tiny)
    return (descriptors / total).sqrt()
