"""Robust estimation: one batched MSAC loop without geometry, and the pose estimators it drives."""

from torchrefrac.ransac.absolute import AbsolutePoseEstimator
from torchrefrac.ransac.msac import Estimator, RansacOptions, RansacReport, ransac
from torchrefrac.ransac.relative import RelativePoseEstimator

__all__ = [
    "AbsolutePoseEstimator",
    "Estimator",
    "RansacOptions",
    "RansacReport",
    "RelativePoseEstimator",
    "ransac",
]
