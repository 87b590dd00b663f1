"""The adjustment as a differentiable layer.

At a minimum x of the cost F(x, theta) the gradient g(x, theta) vanishes, and by the implicit function theorem

    dx / dtheta = -H^-1 dg / dtheta,        H = d^2 F / dx^2,

whatever way the minimum was found. H is the exact Hessian, with the second derivatives of the residuals and of the loss
that Gauss-Newton leaves out; systems with it are solved by conjugate gradients, preconditioned with the factorised
Gauss-Newton matrix, which takes a few steps where residuals are small. A free gauge is fixed by inner constraints
on what is kept.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchrefrac.bundle.adjust import adjust
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.options import BundleOptions
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.rows import differentiable_rows
from torchrefrac.bundle.state import BundleState, Links, Observations
from torchrefrac.bundle.terms import Term
from torchrefrac.optim import GaussNewtonInverse, Step, conjugate_gradients, robust

MAX_STEPS = 100
TOLERANCE = 1e-12


def adjust_differentiably(
    state: BundleState,
    observations: Observations,
    options: BundleOptions | None = None,
    *,
    links: Links | None = None,
    terms: Sequence[Term] = (),
    held: Tensor | None = None,
) -> BundleState:
    """`adjust`, with gradients of the result in whatever tensors require them.

    Gradients flow from rotation, centre, points and from what else is refined to the pixels and weights of the
    observations, to the tensors in `terms`, to the lens, index ratio and planes of `state` where these are held, and
    where they are refined to what is expected of them. Where the search starts does not matter and has no gradient.
    First derivatives only. Meaningful only where the search converged: run `adjust` to see its status. Raises
    ValueError for a frozen ratio, whose search ends beside the minimum.
    """
    options = options or BundleOptions()
    if options.jacobian != "exact":
        raise ValueError(f"options.jacobian is {options.jacobian!r}, but the gradients of a minimum need 'exact'")
    links = links or Links.single(state)
    with torch.no_grad():
        report = adjust(state.detached(), observations.detached(), options, links=links, terms=terms, held=held)
        found = report.state.detached()
    layout = report.problem.layout
    problem = BundleProblem.create(state, layout, observations, options, terms)
    anchored = _with_held(found, state, layout)
    return layout.retract(anchored, _attach(problem, anchored))


def _with_held(found: BundleState, given: BundleState, layout: Layout) -> BundleState:
    """The solution, with the tensors that were given wherever nothing was refined."""
    lens, water, radial = found.lens, {}, 2 if "radial" in layout.lens else 0
    if "focal" not in layout.lens:
        lens = replace(lens, focal=given.lens.focal, check=False)
    if "principal_point" not in layout.lens:
        lens = replace(lens, principal_point=given.lens.principal_point, check=False)
    if "distortion" not in layout.lens:
        parts = (lens.distortion[..., :radial], given.lens.distortion[..., radial:])
        lens = replace(lens, distortion=torch.cat(parts, dim=-1), check=False)
    if "index_ratio" not in layout.water:
        water["index_ratio"] = given.index_ratio
    if "plane_tilt" not in layout.water:
        water["normal"] = given.planes[0]
    if "plane_height" not in layout.water:
        water["offset"] = given.planes[1]
    return replace(found, lens=lens, **water)


def _attach(problem: BundleProblem, solution: BundleState) -> Step:
    """The step -H^-1 g, which is zero, but knows how it depends on everything."""
    with torch.no_grad():
        inverse = GaussNewtonInverse.of(problem.linearize(solution.detached()).system)
    gradient = _gradient(problem, solution)
    zero = torch.zeros_like(gradient).requires_grad_()
    with torch.enable_grad():
        at = solution.detached()
        moved = _gradient(problem.detached(), problem.layout.retract(at, _step(problem, zero)))

    def hessian_times(vector: Tensor) -> Tensor:
        (product,) = torch.autograd.grad(moved, zero, vector, retain_graph=True)
        return product + inverse.gauge_times(vector)

    step = _Solve.apply(
        gradient, lambda right: conjugate_gradients(hessian_times, inverse, right, TOLERANCE, MAX_STEPS)
    )
    return _step(problem, -step)


def _step(problem: BundleProblem, flat: Tensor) -> Step:
    size = problem.layout.size
    nothing = flat.new_zeros(())
    return Step(flat[:size], flat[size:].view(-1, 3), nothing, nothing > -1.0)


def _gradient(problem: BundleProblem, state: BundleState) -> Tensor:
    """Of the cost in all unknowns: the reduced ones, then the points that are not kept. Differentiable."""
    layout, options, plan = problem.layout, problem.options, problem.plan
    kept = state.center.new_zeros(layout.size + 1)
    points = state.center.new_zeros(layout.num_points, 3)
    for seen in (problem.seen, problem.kept_seen):
        if not len(seen):
            continue
        by, residual = differentiable_rows(problem.rows_of, state, layout.links, seen)
        square = residual.square().sum(dim=0)
        pull = residual * robust(square, options.loss, options.loss_scale)[1] * seen.weights
        force = (by * pull[:, None]).sum(dim=0)
        own = force[:-3].T
        if layout.held is not None:
            own = torch.cat((own[:, :6] * (~layout.held)[seen.camera], own[:, 6:]), dim=1)
        kept = kept.index_add(0, plan.columns[seen.camera].flatten(), own.flatten())
        points = points.index_add(0, seen.point, force[-3:].T)
    for term in problem.terms:
        value, jacobian, columns = term.residuals(state, layout)
        pull = options.pixel_sigma**2 * (jacobian.mT @ value[..., None])[..., 0]
        kept = kept.index_add(0, columns.flatten(), pull.flatten())
    if layout.kept is not None:
        which = layout.kept_points
        kept = kept.index_add(0, layout.point_columns(which).flatten(), points[which].flatten())
        points = points[layout.free_points]
    return torch.cat((kept[:-1], points.flatten()))


class _Solve(torch.autograd.Function):
    """x = A^-1 b for a symmetric A that is held."""

    @staticmethod
    def forward(ctx, right: Tensor, solve: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.solve = solve
        return torch.zeros_like(right)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.solve(gradient), None
