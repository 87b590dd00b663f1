"""Bundle adjustment: the bridge between scenes and the optimiser. What varies, the priors, the gauge."""

from torchrefrac.bundle.adjust import BundleOptions, BundleReport, adjust, adjust_pose
from torchrefrac.bundle.gravity import GravityPrior
from torchrefrac.bundle.problem import BundleProblem, BundleState

__all__ = ["BundleOptions", "BundleProblem", "BundleReport", "BundleState", "GravityPrior", "adjust", "adjust_pose"]
