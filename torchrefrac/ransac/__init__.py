"""Robust estimation: one batched LO-MSAC loop without geometry, and the pose estimators it drives."""

from torchrefrac.ransac.many import AbsolutePoseEstimators, RelativePoseEstimators
from torchrefrac.ransac.msac import Estimator, Estimators, RansacOptions, RansacReport, ransac, ransac_each
from torchrefrac.ransac.pose import AbsolutePoseEstimator, RelativePoseEstimator, level_rays

__all__ = [
    "AbsolutePoseEstimator", "AbsolutePoseEstimators", "Estimator", "Estimators", "RansacOptions", "RansacReport",
    "RelativePoseEstimator", "RelativePoseEstimators", "level_rays", "ransac", "ransac_each",
]  # fmt: skip
