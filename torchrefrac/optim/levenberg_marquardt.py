"""Levenberg-Marquardt: a candidate state is accepted or dropped, never changed in place and undone.

A candidate is linearised as it is judged: its cost costs little less than that, and most steps are accepted. One that
is not leaves the linearisation before it as it was, to be solved again with more damping. The damping follows Nielsen's
rule (Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004, Eq. 2.21): continuous in the
gain ratio when a step is accepted, doubling increases when it is not.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Literal, NamedTuple, Protocol, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.checks import Range, require_ranges

State = TypeVar("State")
Status = Literal["converged", "max_iterations", "stalled", "not_finite"]
RANGES = {
    "max_iterations": Range(at_least=0, at_most=1_000_000),
    "function_tolerance": Range(at_least=0.0, at_most=1.0),
    "initial_damping": Range(at_least=0.0, at_most=1e9),
    "max_damping": Range(above=0.0, at_most=1e30),
}


NEAR = 0.03
"""A step that lowers the cost by no more of it leads to the neighbourhood of a minimum."""


class Step(NamedTuple):
    """A proposed change of the reduced and of the eliminated blocks, which only the problem understands;
    predicted_decrease: how much the linear model expects the cost to fall; solved: whether there is a step."""

    reduced: Float[Tensor, " size"]
    eliminated: Float[Tensor, "blocks 3"]
    predicted_decrease: Float[Tensor, ""]
    solved: Bool[Tensor, ""]


class Linearization(Protocol):
    """The problem linearised at one state."""

    @property
    def cost(self) -> Float[Tensor, ""]:
        """Half the sum of (robust) squared residuals at the state."""
        ...

    def solve(self, damping: float) -> Step:
        """The step for H + damping * diag(H)."""
        ...


class Problem(Protocol[State]):
    """A non-linear least-squares problem; states are immutable."""

    def linearize(self, state: State, near: bool = False) -> Linearization:
        """near: whether the last step has hardly lowered the cost, so that second derivatives may be trusted further
        than far from a minimum."""
        ...

    def retract(self, state: State, step: Step) -> State: ...


@dataclass(frozen=True)
class LevenbergMarquardtOptions:
    """Stop after max_iterations or when an accepted step lowers the cost by less than function_tolerance of it."""

    max_iterations: int = 50
    function_tolerance: float = 1e-8
    initial_damping: float = 1e-4
    max_damping: float = 1e12

    def __post_init__(self) -> None:
        require_ranges(self, RANGES)


@dataclass(frozen=True)
class MinimizeReport(Generic[State]):
    """The best state found, why the search ended and the cost after every accepted step (the first one included)."""

    state: State
    status: Status
    iterations: int
    costs: list[float] = field(default_factory=list)


def minimize(
    problem: Problem[State],
    state: State,
    options: LevenbergMarquardtOptions,
    callback: Callable[[int, float, float], None] | None = None,
) -> MinimizeReport[State]:
    """Minimise `problem` from `state`; `callback(iteration, cost, damping)` is called after every accepted step, with
    the cost after it and the damping that it was taken with.

    The state returned is never worse than the one given. Statuses: "converged"; "max_iterations"; "stalled", no step
    lowers the cost at any damping (usually a minimum to rounding); "not_finite", the cost of the start is not a number.
    """
    current = problem.linearize(state)
    cost = float(current.cost)
    costs = [cost]
    if not math.isfinite(cost):
        return MinimizeReport(state, "not_finite", 0, costs)
    damping, growth, near = options.initial_damping, 2.0, False
    for iteration in range(1, options.max_iterations + 1):
        step = current.solve(damping)
        first_try = growth == 2.0  # later ones are damped so much that a small prediction says nothing
        candidate = problem.retract(state, step)
        tried = problem.linearize(candidate, near)
        judged = torch.stack([tried.cost, step.predicted_decrease, step.solved.to(tried.cost)])  # one look at a GPU
        tried_cost, predicted, solved = judged.tolist()
        decrease = cost - tried_cost
        if solved and math.isfinite(tried_cost) and predicted > 0.0 and decrease >= 0.0:
            near = decrease <= NEAR * cost
            state, cost, current = candidate, tried_cost, tried
            costs.append(cost)
            if callback is not None:
                callback(iteration, cost, damping)
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * decrease / predicted - 1.0) ** 3)
            growth = 2.0
            if decrease <= options.function_tolerance * cost:
                return MinimizeReport(state, "converged", iteration, costs)
        else:
            if first_try and solved and 0.0 <= predicted <= options.function_tolerance * cost:
                return MinimizeReport(state, "converged", iteration, costs)
            damping *= growth
            growth *= 2.0
            if damping > options.max_damping:
                return MinimizeReport(state, "stalled", iteration, costs)
    return MinimizeReport(state, "max_iterations", options.max_iterations, costs)
