"""Robust estimation: one batched LO-MSAC loop without geometry, and the pose estimators it drives."""

from torchrefrac.ransac.msac import Estimator, RansacOptions, RansacReport, ransac
from torchrefrac.ransac.pose import AbsolutePoseEstimator, RelativePoseEstimator, level_rays

__all__ = [
    "AbsolutePoseEstimator", "Estimator", "RansacOptions", "RansacReport", "RelativePoseEstimator", "level_rays",
    "ransac",
]  # fmt: skip
