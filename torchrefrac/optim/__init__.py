"""Non-linear least squares: one large problem over two kinds of blocks (`minimize`), or many small ones at once
(`minimize_each`).

The large problem has m reduced blocks of 6 unknowns and n eliminated blocks of 3, n far above m. An observation has r
residuals and depends on one block of either kind; every reduced block besides brings in a member of each of some
families of shared unknowns, and further terms depend on whatever reduced unknowns they name. With c for reduced and p
for eliminated unknowns, the step of Levenberg-Marquardt at damping u solves

    [ B   E ] [dc]     [gc]        B <- B + u diag B,  V <- V + u diag V,
    [ E^T V ] [dp] = - [gp],

where V is 3x3 blocks. Eliminating p (the Schur complement S = B - E V^-1 E^T, Triggs et al., "Bundle adjustment - a
modern synthesis", 2000, section 6) leaves as many equations as there are reduced unknowns.

What is computed when, for N observations of w reduced unknowns each:
- once per problem, `SchurPlan`: the order of the observations and tiles; integers, O(N) memory, a few sorts.
- once per state that is tried, `linearize`: V, B and the gradients from rows of N r (w + 4) numbers; about
  2 N r (w + 1)^2 flops. The rows stay, E is never formed.
- once per damping, `Elimination`: the factors of V, 6 n numbers; then S, from tiles of small dense products, about
  160 n t^2 flops for eliminated blocks that meet t reduced ones; by `Linearized.solver`, see `choose`:
  - dense, up to MAX_DENSE = 7200 reduced unknowns: S itself, size^2 numbers (415 MB in double precision), and
    size^3 / 3 flops of Cholesky, less where many unknowns are in blocks of their own (`BorderedFactor`). Exact also in
    directions that are all but flat.
  - banded, where reduced blocks meet few others each: S as a block tridiagonal matrix with a border, about
    2 size b numbers and 2.3 size b^2 flops for sections of b unknowns. As exact.
  - iterative: conjugate gradients on the blocks of S that are not zero, or where these would be more numbers than the
    rows on S x = E (V^-1 (E^T x)), about 4 N r (w + 3) flops and two passes over the rows an iteration, no memory
    beyond vectors; preconditioned by clusters of blocks and along a few weak directions.
- once at the end, `Covariance` and `GaussNewtonInverse`: banded, as much as three steps, or dense, size^3 flops, up to
  MAX_COVARIANCE = 12000 unknowns.
"""

from torchrefrac.optim.banded import solve_banded
from torchrefrac.optim.batched import Quadratic, SmallProblems, SmallReport, covariance_of, minimize_each, solve_damped
from torchrefrac.optim.choice import Method, ReducedSolver, choose
from torchrefrac.optim.covariance import Covariance, GaussNewtonInverse
from torchrefrac.optim.dense import solve_dense
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.factor import ReducedCovariance, SingularError
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
from torchrefrac.optim.normal_equations import Blocks, NormalEquations, in_cache, linearize
from torchrefrac.optim.plan import REDUCED_SIZE, Family, RowLayout, SchurPlan
from torchrefrac.optim.solve import Linearized

__all__ = [
    "REDUCED_SIZE", "Blocks", "Covariance", "Elimination", "Family", "GaussNewtonInverse", "IterativeOptions",
    "LevenbergMarquardtOptions", "Linearization", "Linearized", "LossName", "Method", "MinimizeReport",
    "NormalEquations", "Problem", "Quadratic", "ReducedCovariance", "ReducedSolver", "RowLayout", "SchurPlan",
    "SingularError", "SmallProblems", "SmallReport", "Status", "Step", "choose", "conjugate_gradients", "covariance_of",
    "huber", "in_cache", "linearize", "minimize", "minimize_each", "robust", "solve_banded", "solve_damped",
    "solve_dense", "solve_iteratively",
]  # fmt: skip
