"""Levenberg-Marquardt for many small problems at once: each has its own damping, accepts and rejects by itself.

The problems know nothing of each other. A step is judged by the cost of the state that it leads to, which is linearised
in the same pass: most steps are accepted, and one pass costs little more than the cost alone.
"""

import math
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

N = TypeVar("N", bound=tuple[Any, ...])
LEAVING = 0.3  # of the problems must be done before it is worth leaving them behind


class Quadratic(NamedTuple):
    """Costs of K problems in D unknowns, their gradients and Gauss-Newton Hessians."""

    cost: Float[Tensor, " k"]
    gradient: Float[Tensor, "k d"]
    hessian: Float[Tensor, "k d d"]


class SmallProblems(Protocol):
    """K problems whose states are rows of D numbers, to which steps are added."""

    def linearize(self, states: Float[Tensor, "k d"]) -> Quadratic:
        """An impossible state has an infinite or NaN cost."""
        ...


class Model(Protocol):
    """A named tuple of costs of K problems in D unknowns, their gradients, and whatever a step is solved from."""

    @property
    def cost(self) -> Float[Tensor, " k"]: ...

    @property
    def gradient(self) -> Float[Tensor, "k d"]: ...


@runtime_checkable
class Structured(Protocol):
    """Problems with a way of their own to solve for steps, and states of E numbers that steps move."""

    def linearize(self, states: Float[Tensor, "k e"]) -> Any:
        """A `Model`; an impossible state has an infinite or NaN cost."""
        ...

    def solve(self, model: Any, damping: Float[Tensor, " k"]) -> Float[Tensor, "k d"]:
        """As `solve_damped`."""
        ...

    def moved(self, states: Float[Tensor, "k e"], step: Float[Tensor, "k d"]) -> Float[Tensor, "k e"]: ...


class SmallReport(NamedTuple):
    """The states, the last quadratic model there, which have converged, and which no step improves at any damping."""

    states: Float[Tensor, "k e"]
    quadratic: Any
    converged: Bool[Tensor, " k"]
    stalled: Bool[Tensor, " k"]


@runtime_checkable
class Separable(SmallProblems, Protocol):
    """Problems of which some can be looked at without the others."""

    def subset(self, rows: Int[Tensor, " some"]) -> "Separable":
        """The problems `rows`, which ascend, alone."""
        ...


def minimize_each(
    problems: SmallProblems | Structured,
    states: Float[Tensor, "k e"],
    max_iterations: int = 20,
    tolerance: float = 1e-8,
    damping: float = 1e-4,
    *,
    max_damping: float = math.inf,
    rounding: float = 0.0,
    undamped: bool = False,
) -> SmallReport:
    """Minimise each problem from its own state; no state ends worse than it began.

    A problem has converged when the decrease that its model still promises, for a step without damping if `undamped`,
    is below `tolerance` of its cost and `rounding`, that of a cost. One that starts from an impossible state, or whose
    model has no minimum at any damping, does not. Problems that have converged or stalled, at a damping beyond
    `max_damping`, stay as they are; `Separable` ones are left out of later iterations.
    """
    solve, moved = (problems.solve, problems.moved) if isinstance(problems, Structured) else (solve_damped, torch.add)
    current = problems.linearize(states)
    damp = torch.full_like(current.cost, damping)
    converged = stalled = torch.zeros_like(current.cost, dtype=torch.bool)
    waiting: list[tuple[Int[Tensor, " some"], SmallReport]] = []  # what has left, and the rows that it had
    rows = torch.arange(len(states), device=states.device)
    for _ in range(max_iterations):
        step = solve(current, damp)
        promised = _promised(current, step)
        solved = promised.isfinite()
        if undamped:
            promised = _promised(current, solve(current, torch.zeros_like(damp)))
        small = promised <= tolerance * current.cost + rounding
        converged = converged | (solved & current.cost.isfinite() & small)
        done = converged | stalled
        finished = int(done.sum())  # one look at a GPU
        if finished == len(rows):
            break
        if isinstance(problems, Separable) and finished > LEAVING * len(rows):
            stay, leave = done.argsort(stable=True).split((len(rows) - finished, finished))
            report = SmallReport(states, current, converged, stalled)
            waiting.append((rows[leave], _rows_of(report, leave)))
            states, current, converged, stalled = _rows_of(report, stay)
            problems, rows, damp, step, solved = problems.subset(stay), rows[stay], damp[stay], step[stay], solved[stay]
            done = done[stay]
        candidate = moved(states, step)
        tried = problems.linearize(candidate)
        better = solved & tried.cost.isfinite() & (tried.cost <= current.cost) & ~done
        states = torch.where(better[:, None], candidate, states)
        current = where_each(better, tried, current)
        damp = torch.where(better, 0.1 * damp, 10.0 * damp)
        stalled = stalled | (~done & (damp > max_damping))
    report = SmallReport(states, current, converged, stalled)
    return _together([*waiting, (rows, report)]) if waiting else report


def where_each(these: Bool[Tensor, " k"], one: N, other: N) -> N:
    """Of some of K problems the rows of the tensors of one named tuple, of the rest those of the other."""
    pairs = zip(one, other, strict=True)
    return type(one)(*(torch.where(these.view(-1, *(1,) * (a.ndim - 1)), a, b) for a, b in pairs))


def _promised(quadratic: Model, step: Float[Tensor, "k d"]) -> Float[Tensor, " k"]:
    """How much lower the models say that costs will be; infinite where a step of zero is no solution."""
    solved = step.any(dim=-1) | ~quadratic.gradient.any(dim=-1)
    return torch.where(solved, -0.5 * (quadratic.gradient * step).sum(dim=-1), torch.inf)


def _rows_of(report: SmallReport, rows: Int[Tensor, " some"]) -> SmallReport:
    quadratic = Quadratic(*(part[rows] for part in report.quadratic))
    return SmallReport(report.states[rows], quadratic, report.converged[rows], report.stalled[rows])


def _together(parts: list[tuple[Int[Tensor, " some"], SmallReport]]) -> SmallReport:
    """Reports of some rows each as one of all."""
    order = torch.cat([rows for rows, _ in parts]).argsort()
    states, quadratics, converged, stalled = zip(*(report for _, report in parts), strict=True)
    quadratic = Quadratic(*(torch.cat(part)[order] for part in zip(*quadratics, strict=True)))
    return SmallReport(torch.cat(states)[order], quadratic, torch.cat(converged)[order], torch.cat(stalled)[order])


def solve_damped(quadratic: Quadratic, damping: Float[Tensor, " k"]) -> Float[Tensor, "k d"]:
    """Steps of (H + damping diag(H)) step = -gradient, in units in which H has a unit diagonal. Zero where the system
    is not positive definite."""
    scaled, scale = _with_unit_diagonal(quadratic.hessian)
    scaled = scaled + torch.diag_embed(damping[:, None].expand_as(scale))
    factor, info = torch.linalg.cholesky_ex(scaled)
    step = -torch.cholesky_solve((scale * quadratic.gradient)[..., None], factor)[..., 0] * scale
    return torch.where((info == 0)[:, None] & step.isfinite(), step, 0.0)


def covariance_of(hessian: Float[Tensor, "k d d"]) -> tuple[Float[Tensor, "k d d"], Bool[Tensor, " k"]]:
    """Inverses of information matrices, and where they exist; zero where they do not."""
    scaled, scale = _with_unit_diagonal(hessian)
    factor, info = torch.linalg.cholesky_ex(scaled)
    exists = (info == 0)[:, None, None]
    identity = torch.eye(scale.shape[-1], dtype=scale.dtype, device=scale.device)
    inverse = torch.cholesky_inverse(torch.where(exists, factor, identity))
    return torch.where(exists, inverse * scale[:, :, None] * scale[:, None, :], 0.0), info == 0


def _with_unit_diagonal(hessian: Float[Tensor, "k d d"]) -> tuple[Float[Tensor, "k d d"], Float[Tensor, "k d"]]:
    """S H S with S = diag(H)^(-1/2), whose units do not matter, and the diagonal of S."""
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    scale = diagonal.clamp(min=torch.finfo(hessian.dtype).tiny).rsqrt()
    return hessian * scale[:, :, None] * scale[:, None, :], scale
