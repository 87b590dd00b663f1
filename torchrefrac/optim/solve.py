"""From normal equations to a step."""

from dataclasses import dataclass, field
from functools import cached_property

from jaxtyping import Float
from torch import Tensor

from torchrefrac.optim.choice import Method, ReducedSolver, choose
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.factor import step_of
from torchrefrac.optim.iterative import IterativeOptions, solve_iteratively
from torchrefrac.optim.levenberg_marquardt import Step
from torchrefrac.optim.normal_equations import NormalEquations


@dataclass(frozen=True)
class Linearized:
    """Normal equations that Levenberg-Marquardt can solve.

    solver: "dense" Cholesky, "banded" Cholesky, "iterative" (preconditioned conjugate gradients on the reduced system,
    never formed), or "auto", see `choose`. coarse: see `solve_iteratively`.
    """

    system: NormalEquations
    solver: ReducedSolver = "auto"
    iterative: IterativeOptions = field(default_factory=IterativeOptions)
    coarse: Float[Tensor, "size directions"] | None = None

    @property
    def cost(self) -> Float[Tensor, ""]:
        return self.system.cost

    @cached_property
    def method(self) -> Method:
        """How the reduced system is solved."""
        return choose(self.system, self.solver)

    def solve(self, damping: float) -> Step:
        """Step of the system damped by `damping` times its own diagonal. `solved` is False when it is singular."""
        system = self.system
        elimination = Elimination(system, damping)
        if self.method.name == "iterative":
            reduced, solved = solve_iteratively(elimination, self.coarse, self.iterative)
        else:
            reduced, solved = step_of(self.method.factor(elimination))
        places = elimination.back_substitute(reduced)
        gain = -(system.gradient @ reduced) - (system.eliminated_gradient * places).sum()
        bend = (system.diagonal * reduced * reduced).sum() + (system.eliminated_diagonal * places * places).sum()
        return Step(reduced, places[:, system.plan.place_of].T, 0.5 * (gain + damping * bend), solved)
