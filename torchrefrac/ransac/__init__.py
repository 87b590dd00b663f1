"""Robust estimation: one batched LO-MSAC loop without geometry, and the pose estimators it drives."""

from torchrefrac.ransac.absolute import AbsolutePoseEstimator
from torchrefrac.ransac.msac import Estimator, RansacOptions, RansacReport, ransac
from torchrefrac.ransac.rays import level_rays
from torchrefrac.ransac.relative import RelativePoseEstimator

__all__ = [
    "AbsolutePoseEstimator", "Estimator", "RansacOptions", "RansacReport", "RelativePoseEstimator", "level_rays",
    "ransac",
]  # fmt: skip
