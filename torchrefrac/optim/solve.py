"""From normal equations to a step."""

from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from torchrefrac.optim.dense import solve_dense
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.iterative import IterativeOptions, solve_iteratively
from torchrefrac.optim.levenberg_marquardt import Step
from torchrefrac.optim.normal_equations import NormalEquations

ReducedSolver = Literal["auto", "dense", "iterative"]
MAX_DENSE = 7200


@dataclass(frozen=True)
class Linearized:
    """Normal equations that Levenberg-Marquardt can solve.

    solver: "dense" Cholesky, "iterative" (preconditioned conjugate gradients on the reduced system, never formed), or
    "auto": dense up to MAX_DENSE reduced unknowns. coarse (size, c): see `solve_iteratively`.
    """

    system: NormalEquations
    solver: ReducedSolver = "auto"
    iterative: IterativeOptions = field(default_factory=IterativeOptions)
    coarse: Tensor | None = None

    @property
    def cost(self) -> Tensor:
        return self.system.cost

    @property
    def is_dense(self) -> bool:
        """Whether the reduced system is formed."""
        return self.solver == "dense" or (self.solver == "auto" and self.system.plan.size <= MAX_DENSE)

    def solve(self, damping: float) -> Step:
        """Step of the system damped by `damping` times its own diagonal. `solved` is False when it is singular."""
        system = self.system
        elimination = Elimination(system, damping)
        if self.is_dense:
            kept, solved = solve_dense(elimination)
        else:
            kept, solved = solve_iteratively(elimination, self.coarse, self.iterative)
        point = elimination.back_substitute(kept)
        gain = -(system.gradient @ kept) - (system.point_gradient * point).sum()
        diagonal = system.point_hessian[[0, 2, 5]]
        bend = (system.diagonal * kept * kept).sum() + (diagonal * point * point).sum()
        return Step(kept, point[:, system.plan.place_of_point].T, 0.5 * (gain + damping * bend), solved)
