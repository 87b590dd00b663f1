"""By what the steps of a reconstruction go, and the options that people set."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from torchrefrac.bundle import BundleOptions, Term
from torchrefrac.checks import Range, require_ranges
from torchrefrac.numerics import AUTO, CPU, device_of, on_device
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.ransac import RansacOptions
from torchrefrac.scene import Part, Scene
from torchrefrac.sfm.pose import PoseInitializer

Measurements = Callable[[Part], Sequence[Term]]
MIN_OBSERVATIONS = 6
WORTH_A_GPU = 20_000
"""Observations of an adjustment from which on it goes to a GPU by itself: a step takes a core 18 ms then, and to begin
its 600 operations on a GPU takes about 5 ms."""
MAX_ERROR = Range(above=0.0, at_most=1e6)
SFM_RANGES = {
    **dict.fromkeys(("min_pair_inliers", "min_registration_inliers"), Range(at_least=1, at_most=1_000_000)),
    **dict.fromkeys(("min_initial_angle_deg", "min_angle_deg"), Range(at_least=0.0, at_most=180.0)),
    **dict.fromkeys(("max_error", "least_error", "rough_error"), MAX_ERROR),
    "min_track_length": Range(at_least=2, at_most=1_000_000),
    "global_growth": Range(at_least=1.0, at_most=1e6),
    "many_images": Range(at_least=1, at_most=1_000_000),
    "final_rounds": Range(at_least=0, at_most=1000),
}


def nothing_measured(part: Part) -> Sequence[Term]:
    """Only pixels."""
    return ()


@dataclass(frozen=True)
class Rules:
    """What the verbs `start`, `register`, `triangulate`, `filter_points` and `adjust` need besides the scene.

    max_error, in pixels: of an observation that is accepted. max_dropped: observations of a new point that may be left
    out for that, the worst first. min_angle_deg: between the rays of a point, 0 for any.
    min_track_length: accepted observations that a point needs, one number for all or one for each. min_support:
    accepted observations that a registered view needs. min_registration_inliers: of a pose.

    rough: poses may be far off, so that a point is first put where its observations meet best under a loss in which
    errors beyond `loss_scale` pixels count linearly, and judged there. bundle: how to adjust. measurements: what is
    known besides pixels of a part of the scene. fixed_poses: points and water alone are adjusted. poses: finds poses
    without a start; seed: of the random samples of each view. device: where adjustments are done, see `device_of`;
    auto: on the CPU where they have fewer than WORTH_A_GPU observations.
    """

    max_error: float = 4.0
    max_dropped: int = 3
    min_angle_deg: float = 1.5
    min_track_length: int | Int[Tensor, " n"] = 2
    min_support: int = MIN_OBSERVATIONS
    min_registration_inliers: int = 20
    rough: bool = False
    loss_scale: float = 4.0
    bundle: BundleOptions = field(default_factory=BundleOptions)
    measurements: Measurements = nothing_measured
    fixed_poses: bool = False
    poses: PoseInitializer | None = None
    seed: int = 0
    device: str = AUTO

    def to_adjust(self, part: Part) -> tuple[Scene, Sequence[Term]]:
        """The scene of a part and what was measured of it, where that is adjusted."""
        is_small = self.device == AUTO and len(part.scene.observations) < WORTH_A_GPU
        device = CPU if is_small else device_of(self.device)
        return on_device((part.scene, self.measurements(part)), device)


@dataclass(frozen=True)
class SfmOptions:
    """Thresholds in pixels and degrees.

    ransac.max_error is the error of a match or point at a good pose: gravity's own error is part of the pose.
    min_pair_inliers: fewer verified matches make no pair.
    min_initial_angle_deg: median angle between the rays of the initial pair. min_angle_deg: of an accepted point.
    max_error: of an accepted observation. least_error: what that may come down to once an adjustment shows how large
    errors are; None: it stays. rough_error: see `rough`. min_track_length: images that must see a final point (2 where
    only 2 are registered). global_growth: adjust everything whenever the number of images has grown by this factor.
    many_images: from so many on views are registered in rounds, these are mostly adjustments of the views that have
    joined and of their neighbours, and the last ones end when the cost hardly falls any more. device: where pairs are
    verified and views registered, see `device_of`, and adjustments are done, see `Rules`.
    """

    ransac: RansacOptions = field(default_factory=lambda: RansacOptions(max_samples=8192))
    bundle: BundleOptions = field(default_factory=BundleOptions)
    min_pair_inliers: int = 20
    min_registration_inliers: int = 20
    min_initial_angle_deg: float = 5.0
    min_angle_deg: float = 1.5
    max_error: float = 4.0
    least_error: float | None = None
    rough_error: float = 16.0
    min_track_length: int = 3
    global_growth: float = 1.1
    many_images: int = 40
    final_rounds: int = 3
    device: str = AUTO

    def __post_init__(self) -> None:
        require_ranges(self, SFM_RANGES)
        device_of(self.device)

    @property
    def rough(self) -> "SfmOptions":
        """For observations that err by more than max_error and by up to rough_error, as over waves."""
        return replace(
            self,
            ransac=replace(self.ransac, max_error=max(self.ransac.max_error, self.rough_error)),
            max_error=max(self.max_error, self.rough_error),
            least_error=self.max_error,
        )

    def rules(
        self, poses: PoseInitializer, measurements: Measurements = nothing_measured, seed: int | torch.Generator = 0
    ) -> Rules:
        """By what an incremental reconstruction goes."""
        return Rules(
            max_error=self.max_error,
            min_angle_deg=self.min_angle_deg,
            min_registration_inliers=self.min_registration_inliers,
            bundle=self.bundle,
            measurements=measurements,
            poses=poses,
            seed=int(torch.randint(1 << 31, (), generator=seed)) if isinstance(seed, torch.Generator) else seed,
            device=self.device,
        )


@dataclass(frozen=True)
class ReadjustOptions:
    """How a whole scene is adjusted again.

    max_error: of an accepted observation, pixels. rounds: of dropping observations and adjusting again. held:
    "cameras" leaves the poses as they are. device: as of `Rules`.
    """

    held: Literal["none", "cameras"] = "none"
    max_error: float = 4.0
    rounds: int = 3
    bundle: BundleOptions = field(
        default_factory=lambda: BundleOptions(
            loss_scale=0.5, pixel_sigma=0.5, solver=LevenbergMarquardtOptions(max_iterations=100)
        )
    )
    device: str = AUTO

    def __post_init__(self) -> None:
        require_ranges(self, {"max_error": MAX_ERROR, "rounds": Range(at_least=1, at_most=1000)})
        device_of(self.device)

    def rules(self, measurements: Measurements, min_track_length: int | Int[Tensor, " n"]) -> Rules:
        """By what a whole scene is adjusted again."""
        fixed = self.held == "cameras"
        return Rules(
            max_error=self.max_error,
            min_angle_deg=0.0,
            min_track_length=min_track_length,
            min_support=0 if fixed else MIN_OBSERVATIONS,
            rough=True,
            loss_scale=self.max_error,
            bundle=self.bundle,
            measurements=measurements,
            fixed_poses=fixed,
            device=self.device,
        )
