"""From normal equations to a step."""

from dataclasses import dataclass, field
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from torchrefrac.optim.dense import solve_dense
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.iterative import IterativeOptions, solve_iteratively
from torchrefrac.optim.levenberg_marquardt import Step
from torchrefrac.optim.normal_equations import DIAGONAL, NormalEquations

ReducedSolver = Literal["auto", "dense", "iterative"]
MAX_DENSE = 7200


@dataclass(frozen=True)
class Linearized:
    """Normal equations that Levenberg-Marquardt can solve.

    solver: "dense" Cholesky, "iterative" (preconditioned conjugate gradients on the reduced system, never formed), or
    "auto": dense up to MAX_DENSE reduced unknowns. coarse: see `solve_iteratively`.
    """

    system: NormalEquations
    solver: ReducedSolver = "auto"
    iterative: IterativeOptions = field(default_factory=IterativeOptions)
    coarse: Float[Tensor, "size directions"] | None = None

    @property
    def cost(self) -> Float[Tensor, ""]:
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
            reduced, solved = solve_dense(elimination)
        else:
            reduced, solved = solve_iteratively(elimination, self.coarse, self.iterative)
        places = elimination.back_substitute(reduced)
        gain = -(system.gradient @ reduced) - (system.eliminated_gradient * places).sum()
        diagonal = system.eliminated_hessian[DIAGONAL]
        bend = (system.diagonal * reduced * reduced).sum() + (diagonal * places * places).sum()
        return Step(reduced, places[:, system.plan.place_of].T, 0.5 * (gain + damping * bend), solved)
