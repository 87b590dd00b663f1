"""Adjust cameras and points together, or one camera alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchrefrac.bundle.inputs import check_inputs
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.observability import unseen
from torchrefrac.bundle.options import BundleOptions
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.state import BundleState, Links, Observations
from torchrefrac.bundle.terms import Term, concerned_points
from torchrefrac.optim import Status, minimize


@dataclass(frozen=True)
class BundleReport:
    """The adjusted state, why the search ended (see `optim.minimize`) and the cost after every accepted step.

    held: what was to be refined but was not, because the data do not determine it, and by how little they do.
    problem: what was minimised, for `uncertainty`.
    """

    state: BundleState
    status: Status
    iterations: int
    costs: list[float]
    problem: BundleProblem
    held: dict[str, str] = field(default_factory=dict)

    def summary(self) -> str:
        """How it went, in a line."""
        return f"cost {self.costs[0]:.6g} to {self.costs[-1]:.6g} in {self.iterations} iterations, {self.status}"


def adjust(
    state: BundleState,
    observations: Observations,
    options: BundleOptions | None = None,
    *,
    links: Links | None = None,
    terms: Sequence[Term] = (),
    held: Tensor | None = None,
    check: bool = True,
    callback: Callable[[int, float, float], None] | None = None,
) -> BundleReport:
    """Minimise the reprojection error, and that of all `terms`, over all that varies (paper, section 3.5, and more).

    links: which lens and which water plane each image has; by default there is one of each. terms: measurements
    besides pixels. held (m, 6): unknowns of the poses (rotation, then centre) that stay as they are. What else varies
    is in the options. A gauge that nothing fixes is free: the result is then as near to the start as the data allow
    (shifts along the water, heading, scale about it; at index ratio 1 all similarities).

    Unknowns in `options.refine` that the data do not determine are held unless `options.refine_unseen`, and the report
    says so. check: raise UnadjustableError for what cannot be adjusted, see `check_inputs`; any failure after that is
    a status.
    """
    options = options or BundleOptions()
    links = links or Links.single(state)
    kept = concerned_points(terms, len(state.points), state.points)
    if check:
        check_inputs(state, observations, links, held, known=kept)
    layout = Layout.create(state, links, options.refine, held, kept=kept)
    problem = BundleProblem.create(state, layout, observations, options, terms)
    refused = {} if options.refine_unseen else unseen(problem, state, options.pixel_sigma)
    if refused:
        layout = Layout.create(state, links, tuple(u for u in options.refine if u not in refused), held, kept=kept)
        problem = problem.with_layout(state, layout, options, problem.terms)  # no term is about what is refused
    report = minimize(problem, state, options.solver, callback)
    problem.spare.clear()
    return BundleReport(report.state, report.status, report.iterations, report.costs, problem, refused)


def adjust_pose(
    state: BundleState, pixels: Tensor, options: BundleOptions | None = None, terms: Sequence[Term] = ()
) -> BundleReport:
    """Minimise the reprojection error of one camera (m = 1) that sees all points of `state` at pixels (n, 2).

    Points, lens and water are held.
    """
    options = replace(options or BundleOptions(), refine=())
    count = torch.arange(len(state.points), device=pixels.device)
    layout = Layout.create(state, Links.single(state), hold_points=True)
    problem = BundleProblem.create(state, layout, Observations(torch.zeros_like(count), count, pixels), options, terms)
    report = minimize(problem, state, options.solver)
    return BundleReport(report.state, report.status, report.iterations, report.costs, problem)
