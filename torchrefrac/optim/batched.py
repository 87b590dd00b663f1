"""Levenberg-Marquardt for many small problems at once: each has its own damping, accepts and rejects by itself.

The problems know nothing of each other. A step is judged by the cost of the state that it leads to, which is linearised
in the same pass: most steps are accepted, and one pass costs little more than the cost alone.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

LEAVING = 0.3  # of the problems must have converged before it is worth leaving them behind


class Quadratic(NamedTuple):
    """Costs (K) of K problems in D unknowns, their gradients (K, D) and Gauss-Newton Hessians (K, D, D)."""

    cost: Tensor
    gradient: Tensor
    hessian: Tensor


class SmallProblems(Protocol):
    """K problems whose states are rows of D numbers, to which steps are added."""

    def linearize(self, states: Tensor) -> Quadratic:
        """At states (K, D). An impossible state has an infinite or NaN cost."""
        ...


class SmallReport(NamedTuple):
    """states (K, D), the last quadratic model there, and which have converged (K)."""

    states: Tensor
    quadratic: Quadratic
    converged: Tensor


@runtime_checkable
class Separable(SmallProblems, Protocol):
    """Problems of which some can be looked at without the others."""

    def subset(self, rows: Tensor) -> "Separable":
        """The problems `rows` (k) alone."""
        ...


def minimize_each(
    problems: SmallProblems,
    states: Tensor,
    max_iterations: int = 20,
    tolerance: float = 1e-8,
    damping: float = 1e-4,
) -> SmallReport:
    """Minimise each problem from its own state (K, D); no state ends worse than it began.

    A problem has converged when the decrease that its model still promises is below `tolerance` of its cost. One that
    starts from an impossible state, or whose model has no minimum at any damping, does not. `Separable` problems that
    have converged are left out of later iterations.
    """
    current = problems.linearize(states)
    damp = torch.full_like(current.cost, damping)
    converged = torch.zeros_like(current.cost, dtype=torch.bool)
    waiting: list[tuple[Tensor, SmallReport]] = []  # what has left, and the rows that it had
    rows = torch.arange(len(states), device=states.device)
    for _ in range(max_iterations):
        step = solve_damped(current, damp)
        promised = -0.5 * (current.gradient * step).sum(dim=-1)
        solved = step.any(dim=-1) | ~current.gradient.any(dim=-1)
        converged = converged | (solved & current.cost.isfinite() & (promised <= tolerance * current.cost))
        if bool(converged.all()):
            break
        if isinstance(problems, Separable) and int(converged.sum()) > LEAVING * len(rows):
            leave, stay = converged.nonzero()[:, 0], (~converged).nonzero()[:, 0]
            waiting.append((rows[leave], _rows_of(SmallReport(states, current, converged), leave)))
            states, current, converged = _rows_of(SmallReport(states, current, converged), stay)
            problems, rows, damp, step, solved = problems.subset(stay), rows[stay], damp[stay], step[stay], solved[stay]
        tried = problems.linearize(states + step)
        better = solved & tried.cost.isfinite() & (tried.cost <= current.cost) & ~converged
        states = torch.where(better[:, None], states + step, states)
        current = Quadratic(
            torch.where(better, tried.cost, current.cost),
            torch.where(better[:, None], tried.gradient, current.gradient),
            torch.where(better[:, None, None], tried.hessian, current.hessian),
        )
        damp = torch.where(better, 0.1 * damp, 10.0 * damp)
    report = SmallReport(states, current, converged)
    return _together([*waiting, (rows, report)]) if waiting else report


def _rows_of(report: SmallReport, rows: Tensor) -> SmallReport:
    quadratic = Quadratic(*(part[rows] for part in report.quadratic))
    return SmallReport(report.states[rows], quadratic, report.converged[rows])


def _together(parts: list[tuple[Tensor, SmallReport]]) -> SmallReport:
    """Reports of some rows each as one of all."""
    order = torch.cat([rows for rows, _ in parts]).argsort()
    reports = [report for _, report in parts]
    quadratic = Quadratic(*(torch.cat(part)[order] for part in zip(*(r.quadratic for r in reports), strict=True)))
    return SmallReport(
        torch.cat([r.states for r in reports])[order], quadratic, torch.cat([r.converged for r in reports])[order]
    )


def solve_damped(quadratic: Quadratic, damping: Tensor) -> Tensor:
    """Steps (K, D) of (H + damping diag(H)) step = -gradient, in units in which H has a unit diagonal.

    Zero where the system is not positive definite.
    """
    scaled, scale = _with_unit_diagonal(quadratic.hessian)
    scaled = scaled + torch.diag_embed(damping[:, None].expand_as(scale))
    factor, info = torch.linalg.cholesky_ex(scaled)
    step = -torch.cholesky_solve((scale * quadratic.gradient)[..., None], factor)[..., 0] * scale
    return torch.where((info == 0)[:, None] & step.isfinite(), step, 0.0)


def covariance_of(hessian: Tensor) -> tuple[Tensor, Tensor]:
    """Inverses (K, D, D) of information matrices, and where they exist (K); zero where they do not."""
    scaled, scale = _with_unit_diagonal(hessian)
    factor, info = torch.linalg.cholesky_ex(scaled)
    exists = (info == 0)[:, None, None]
    identity = torch.eye(scale.shape[-1], dtype=scale.dtype, device=scale.device)
    inverse = torch.cholesky_inverse(torch.where(exists, factor, identity))
    return torch.where(exists, inverse * scale[:, :, None] * scale[:, None, :], 0.0), info == 0


def _with_unit_diagonal(hessian: Tensor) -> tuple[Tensor, Tensor]:
    """S H S with S = diag(H)^(-1/2), whose units do not matter, and the diagonal of S (K, D)."""
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    scale = diagonal.clamp(min=torch.finfo(hessian.dtype).tiny).rsqrt()
    return hessian * scale[:, :, None] * scale[:, None, :], scale
