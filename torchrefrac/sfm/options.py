"""Options of the incremental reconstruction."""

from dataclasses import dataclass, field

from torchrefrac.bundle import BundleOptions
from torchrefrac.ransac import RansacOptions


@dataclass(frozen=True)
class SfmOptions:
    """Thresholds in pixels and degrees.

    ransac.max_error is the error of a match or point at a good pose: gravity's own error is part of the pose.
    min_pair_inliers: fewer verified matches make no pair.
    min_initial_angle_deg: median angle between the rays of the initial pair. min_angle_deg: of a point that is kept.
    max_error: of an observation that is kept. min_track_length: images that must see a final point (2 where only 2
    are registered). global_growth: adjust everything whenever the number of images has grown by this factor.
    """

    ransac: RansacOptions = field(default_factory=lambda: RansacOptions(max_samples=8192))
    bundle: BundleOptions = field(default_factory=BundleOptions)
    min_pair_inliers: int = 20
    min_registration_inliers: int = 20
    min_initial_angle_deg: float = 5.0
    min_angle_deg: float = 1.5
    max_error: float = 4.0
    min_track_length: int = 3
    global_growth: float = 1.1
    final_rounds: int = 3
