"""Non-linear least squares for problems of two kinds of blocks; knows no cameras and no scenes."""

from torchrefrac.optim.batched import Quadratic, SmallProblems, SmallReport, covariance_of, minimize_each, solve_damped
from torchrefrac.optim.levenberg_marquardt import (
    LevenbergMarquardtOptions,
    Linearization,
    MinimizeReport,
    Problem,
    Step,
    minimize,
)
from torchrefrac.optim.loss import huber
from torchrefrac.optim.schur import NormalEquations, SchurPlan

__all__ = [
    "LevenbergMarquardtOptions",
    "Linearization",
    "MinimizeReport",
    "NormalEquations",
    "Problem",
    "Quadratic",
    "SchurPlan",
    "SmallProblems",
    "SmallReport",
    "Step",
    "covariance_of",
    "huber",
    "minimize",
    "minimize_each",
    "solve_damped",
]
