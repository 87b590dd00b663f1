"""Robust estimation: one batched LO-MSAC loop without geometry, and the pose estimators it drives."""

from torchrefrac.ransac.absolute import AbsolutePoseEstimator
from torchrefrac.ransac.msac import Estimator, RansacOptions, RansacReport, ransac
from torchrefrac.ransac.rays import level_rays
from torchrefrac.ransac.relative import RelativePoseEstimator
from torchrefrac.ransac.unknown_vertical import UnknownVertical, find_verticals, pinhole_rotation

__all__ = [
    "AbsolutePoseEstimator",
    "Estimator",
    "RansacOptions",
    "RansacReport",
    "RelativePoseEstimator",
    "UnknownVertical",
    "find_verticals",
    "level_rays",
    "pinhole_rotation",
    "ransac",
]
