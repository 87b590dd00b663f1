"""Options of the dense reconstruction."""

from dataclasses import dataclass, field
from typing import Literal

from torchrefrac.checks import Range, require_ranges
from torchrefrac.numerics import AUTO, device_of

Method = Literal["none", "patch", "depthmap"]
COUNT, SOME = Range(at_least=1, at_most=1_000_000), Range(at_least=2, at_most=1_000_000)
SWEEP_RANGES = {"planes": SOME, "level": Range(at_least=0, at_most=16), "window": Range(at_most=1001)}
RANGES = {
    **dict.fromkeys(("cell", "views", "neighbours", "max_tile"), COUNT),
    **dict.fromkeys(("min_views", "maps"), SOME),
    "batch": Range(at_least=1, at_most=1_000_000_000),
    "window": Range(at_most=1001),
    "levels": Range(at_least=1, at_most=16),
    "angle_best": Range(above=0.0),
    "angle_max": Range(at_most=180.0),
    "max_slant": Range(above=0.0),
    "min_contrast": Range(at_least=0.0, at_most=255.0),
    "noise": Range(above=0.0, at_most=255.0),
    "max_sigma": Range(above=0.0, at_most=1e6),
    "loss_scale": Range(above=0.0, at_most=1e6),
    "iterations": Range(at_least=0, at_most=1_000_000),
    "last_step": Range(above=0.0, at_most=1e6),
}


@dataclass(frozen=True)
class SweepOptions:
    """Where the depth-map method looks first: `planes` distances a cell, in copies of the images that are `level` times
    halved, in windows of window x window pixels there; a score below min_score is no beginning."""

    planes: int = 96
    level: int = 2
    window: int = 5
    min_score: float = 0.6

    def __post_init__(self) -> None:
        require_ranges(self, SWEEP_RANGES)
        _require_window(self.window)
        _require_score(self.min_score)


@dataclass(frozen=True)
class DenseOptions:
    """How a surface is made dense. Lengths in pixels, angles in degrees, contrast and noise in grey levels of 255.

    method: patch grows patches from matched features, depthmap sweeps every image, none leaves it at sparse points.
    cell: one patch at most in every cell x cell pixels. window: of the patches, odd. interpolation of the other images.
    views: with how many others at most a patch is compared, of `neighbours` that its image has; min_views must agree
    (the reference included; two where there are only two images) to min_score, as zero-normalised cross-correlation.
    maps: of the depth-map method, how many images find each piece of surface, before they are fused.
    angle_best and angle_max: between the rays of two images. max_slant: of a patch against the viewing ray.
    min_contrast: a window's standard deviation; noise: the least that is assumed of an image. max_sigma: of a patch
    along its ray, as the shift that it makes in the other images. loss_scale: of 1 - ZNCC, where an image begins to
    count less. levels: sizes of each image, every one half of the one before. iterations: of a patch's adjustment,
    which ends with a step that moves it by less than last_step pixels in the other images.
    batch: patches refined at once. max_tile: pixels across of what is worked on at once, for large images. device:
    where the work is done, see `device_of`.

    Raises ValueError for values that cannot be right.
    """

    method: Method = "none"
    cell: int = 3
    window: int = 7
    interpolation: Literal["bilinear", "bicubic"] = "bicubic"
    views: int = 5
    neighbours: int = 10
    min_views: int = 3
    min_score: float = 0.75
    maps: int = 3
    angle_best: float = 20.0
    angle_max: float = 60.0
    max_slant: float = 75.0
    min_contrast: float = 1.0
    noise: float = 0.7
    max_sigma: float = 0.5
    loss_scale: float = 0.3
    levels: int = 3
    iterations: int = 6
    last_step: float = 0.15
    batch: int = 2048
    max_tile: int = 2048
    device: str = AUTO
    sweep: SweepOptions = field(default_factory=SweepOptions)

    def __post_init__(self) -> None:
        require_ranges(self, RANGES)
        _require_window(self.window)
        if self.min_views > self.views + 1:
            raise ValueError(
                f"min_views is {self.min_views}, but can be views + 1 = {self.views + 1} at most: no more are compared"
            )
        _require_score(self.min_score)
        if self.angle_best >= self.angle_max:
            raise ValueError(f"angle_best is {self.angle_best:g}, but must be below angle_max, {self.angle_max:g}")
        if self.max_slant >= 90.0:
            raise ValueError(
                f"max_slant is {self.max_slant:g}, but must be below 90 degrees: a patch has to face the ray"
            )
        device_of(self.device)
        if self.method == "depthmap" and self.levels <= max(self.sweep.level, 1):
            raise ValueError(
                f"levels is {self.levels}, but a sweep in copies that are halved {self.sweep.level} times needs "
                f"{max(self.sweep.level, 1) + 1}"
            )


def _require_window(window: int) -> None:
    if window < 3 or window % 2 == 0:
        raise ValueError(f"window is {window}, but must be odd, so that it has a middle, and at least 3")


def _require_score(score: float) -> None:
    if not 0.0 < score < 1.0:
        raise ValueError(f"min_score is {score:g}, but must lie between 0 and 1")
