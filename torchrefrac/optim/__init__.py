"""Non-linear least squares for problems of two kinds of blocks; knows no cameras and no scenes."""

from torchrefrac.optim.batched import Quadratic, SmallProblems, SmallReport, covariance_of, minimize_each, solve_damped
from torchrefrac.optim.covariance import Covariance
from torchrefrac.optim.dense import solve_dense
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.inverse import GaussNewtonInverse, SingularError
from torchrefrac.optim.iterative import IterativeOptions, conjugate_gradients, solve_iteratively
from torchrefrac.optim.levenberg_marquardt import (
    LevenbergMarquardtOptions,
    Linearization,
    MinimizeReport,
    Problem,
    Status,
    Step,
    minimize,
)
from torchrefrac.optim.loss import LossName, huber, robust
from torchrefrac.optim.normal_equations import Blocks, NormalEquations, linearize
from torchrefrac.optim.plan import Family, SchurPlan
from torchrefrac.optim.solve import Linearized, ReducedSolver

__all__ = [
    "Blocks",
    "Covariance",
    "Elimination",
    "Family",
    "GaussNewtonInverse",
    "IterativeOptions",
    "LevenbergMarquardtOptions",
    "Linearization",
    "Linearized",
    "LossName",
    "MinimizeReport",
    "NormalEquations",
    "Problem",
    "Quadratic",
    "ReducedSolver",
    "SchurPlan",
    "SingularError",
    "SmallProblems",
    "SmallReport",
    "Status",
    "Step",
    "conjugate_gradients",
    "covariance_of",
    "huber",
    "linearize",
    "minimize",
    "minimize_each",
    "robust",
    "solve_damped",
    "solve_dense",
    "solve_iteratively",
]
