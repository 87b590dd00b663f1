"""Options of the dense reconstruction."""

from dataclasses import dataclass, field
from typing import Literal

Method = Literal["none", "patch", "depthmap"]


@dataclass(frozen=True)
class SweepOptions:
    """Where the depth-map method looks first: `planes` distances a cell, in copies of the images that are `level` times
    halved, in windows of window x window pixels there; a score below min_score is no beginning."""

    planes: int = 96
    level: int = 2
    window: int = 5
    min_score: float = 0.6


@dataclass(frozen=True)
class DenseOptions:
    """How a surface is made dense. Lengths in pixels, angles in degrees, contrast and noise in grey levels of 255.

    method: patch grows patches from matched features, depthmap sweeps every image, none leaves it at sparse points.
    cell: one patch at most in every cell x cell pixels. window: of the patches, odd. interpolation of the other images.
    views: with how many others at most a patch is compared, of `neighbours` that its image has; min_views must agree
    (the reference included; two where there are only two images) to min_score, as zero-normalised cross-correlation.
    angle_best and angle_max: between the rays of two images. max_slant: of a patch against the viewing ray. min_contrast:
    a window's standard deviation; noise: the least that is assumed of an image. max_sigma: of a patch along its ray, as
    the shift that it makes in the other images. loss_scale: of 1 - ZNCC, where an image begins to count less.
    batch: patches refined at once. max_tile: pixels across of what is worked on at once, for large images.
    """

    method: Method = "none"
    cell: int = 3
    window: int = 7
    interpolation: Literal["bilinear", "bicubic"] = "bilinear"
    views: int = 5
    neighbours: int = 10
    min_views: int = 3
    min_score: float = 0.75
    angle_best: float = 20.0
    angle_max: float = 60.0
    max_slant: float = 75.0
    min_contrast: float = 1.0
    noise: float = 0.7
    max_sigma: float = 0.5
    loss_scale: float = 0.3
    levels: int = 3
    iterations: int = 8
    batch: int = 2048
    max_tile: int = 2048
    sweep: SweepOptions = field(default_factory=SweepOptions)
