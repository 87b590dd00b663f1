"""Non-linear least squares for problems of two kinds of blocks; knows no cameras and no scenes."""

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
    "SchurPlan",
    "Step",
    "huber",
    "minimize",
]
