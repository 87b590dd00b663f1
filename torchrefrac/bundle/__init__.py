"""Bundle adjustment: the bridge between scenes and the optimiser. What varies, the priors, the gauge."""

from torchrefrac.bundle.adjust import BundleReport, adjust, adjust_pose
from torchrefrac.bundle.common_errors import CommonErrors
from torchrefrac.bundle.implicit import adjust_differentiably
from torchrefrac.bundle.inputs import UnadjustableError, check_inputs
from torchrefrac.bundle.many import BatchReport, BundleBatch, adjust_each
from torchrefrac.bundle.observability import Determination, determinations
from torchrefrac.bundle.options import BundleOptions
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.score import wished_changes
from torchrefrac.bundle.terms import (
    CenterPrior,
    Expectations,
    GravityPrior,
    HeightPrior,
    KnownPoints,
    ScaleBars,
    Term,
    WaterLevels,
    Waterline,
    WaterSlope,
)
from torchrefrac.bundle.uncertainty import Uncertainty, estimate_pixel_sigma, uncertainty

__all__ = [
    "BatchReport", "BundleBatch", "BundleOptions", "BundleProblem", "BundleReport", "CenterPrior", "CommonErrors",
    "Determination", "Expectations", "GravityPrior", "HeightPrior", "KnownPoints", "ScaleBars", "Term",
    "UnadjustableError", "Uncertainty", "WaterLevels", "WaterSlope", "Waterline", "adjust", "adjust_differentiably",
    "adjust_each", "adjust_pose", "check_inputs", "determinations", "estimate_pixel_sigma", "uncertainty",
    "wished_changes",
]  # fmt: skip
