"""The adjustment as a differentiable layer.

At a minimum x of the cost F(x, theta) the gradient g(x, theta) vanishes, and by the implicit function theorem

    dx / dtheta = -H^-1 dg / dtheta,        H = d^2 F / dx^2,

whatever way the minimum was found. H is the exact Hessian, with the second derivatives of the residuals and of the loss
that Gauss-Newton leaves out; systems with it are solved by conjugate gradients, preconditioned with the factorised
Gauss-Newton matrix, which takes a few steps where residuals are small. A free gauge is fixed by inner constraints
on the reduced unknowns.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.bundle.adjust import adjust
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.options import BundleOptions
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.rows import INTRINSICS, differentiable_rows
from torchrefrac.bundle.terms import Term
from torchrefrac.optim import GaussNewtonInverse, Step, conjugate_gradients, robust
from torchrefrac.scene import Scene

MAX_STEPS = 100
TOLERANCE = 1e-12


def adjust_differentiably(
    scene: Scene,
    options: BundleOptions | None = None,
    *,
    terms: Sequence[Term] = (),
    fixed: Bool[Tensor, "m 6"] | None = None,
) -> Scene:
    """`adjust`, with gradients of the result in whatever tensors require them.

    Gradients flow from rotation, centre, points and from what else is refined to the pixels and weights of the
    observations, to the tensors in `terms`, to the intrinsics, index ratio and planes of `scene` where these are fixed,
    and where they are refined to what is expected of them. Where the search starts does not matter and has no gradient.
    First derivatives only. Meaningful only where the search converged: run `adjust` to see its status. Raises
    ValueError for a frozen ratio, whose search ends beside the minimum.
    """
    options = options or BundleOptions()
    if options.jacobian != "exact":
        raise ValueError(f"options.jacobian is {options.jacobian!r}, but the gradients of a minimum need 'exact'")
    with torch.no_grad():
        report = adjust(scene.detached(), options, terms=terms, fixed=fixed)
    layout = report.problem.layout
    problem = BundleProblem.create(scene, layout, options, terms)
    anchored = _with_given(report.scene.detached(), scene, layout)
    return layout.retract(anchored, _attach(problem, anchored))


def _with_given(found: Scene, given: Scene, layout: Layout) -> Scene:
    """The solution, with the tensors that were given wherever nothing was refined."""
    refined = max((INTRINSICS[name].width for name in ("radial", "distortion") if name in layout.intrinsics), default=0)
    distortion = torch.cat((found.cameras.distortion[:, :refined], given.cameras.distortion[:, refined:]), dim=-1)
    exact = {n: getattr(given.cameras, n) for n in ("focal", "principal_point") if n not in layout.intrinsics}
    fields = {
        "index_ratio": "index_ratio",
        "layer_index": "layers",
        "layer_thickness": "thickness",
        "plane_tilt": "normal",
        "plane_height": "offset",
    }
    return replace(
        found,
        cameras=replace(found.cameras, distortion=distortion, **exact),
        interfaces=replace(
            found.interfaces,
            **{of: getattr(given.interfaces, of) for key, of in fields.items() if key not in layout.water},
        ),
        observations=given.observations,
    )


def _attach(problem: BundleProblem, solution: Scene) -> Step:
    """The step -H^-1 g, which is zero, but knows how it depends on everything."""
    at = solution.detached()
    with torch.no_grad():
        inverse = GaussNewtonInverse.of(problem.linearize(at).system)
    gradient = _gradient(problem, solution)
    zero = torch.zeros_like(gradient).requires_grad_()
    with torch.enable_grad():
        moved = _gradient(problem.detached(), problem.layout.retract(at, _step(problem, zero)))

    def hessian_times(vector: Float[Tensor, " unknowns"]) -> Float[Tensor, " unknowns"]:
        (product,) = torch.autograd.grad(moved, zero, vector, retain_graph=True)
        return product + inverse.gauge_times(vector)

    step = _Solve.apply(
        gradient, lambda right: conjugate_gradients(hessian_times, inverse, right, TOLERANCE, MAX_STEPS)
    )
    return _step(problem, -step)


def _step(problem: BundleProblem, flat: Float[Tensor, " unknowns"]) -> Step:
    size = problem.layout.size
    nothing = flat.new_zeros(())
    return Step(flat[:size], flat[size:].view(-1, 3), nothing, nothing > -1.0)


def _gradient(problem: BundleProblem, scene: Scene) -> Float[Tensor, " unknowns"]:
    """Of the cost in all unknowns: the reduced ones, then the points that are eliminated. Differentiable."""
    layout, options, plan = problem.layout, problem.options, problem.plan
    reduced = scene.points.new_zeros(layout.size + 1)
    points = scene.points.new_zeros(layout.num_points, 3)
    for seen in (problem.seen, problem.seen_reduced):
        if not len(seen):
            continue
        by, residual = differentiable_rows(problem.rows_of, scene, seen)
        square = residual.square().sum(dim=0)
        pull = residual * robust(square, options.loss, options.loss_scale)[1] * seen.weights
        force = (by * pull[:, None]).sum(dim=0)
        own = force[plan.layout.reduced].T
        if (constant := layout.constant) is not None:
            own = own * (~constant)[seen.view]
        reduced = reduced.index_add(0, plan.columns[seen.view].flatten(), own.flatten())
        points = points.index_add(0, seen.point, force[plan.layout.eliminated].T)
    for term in problem.terms:
        value, jacobian, columns = term.residuals(scene, layout)
        pull = options.pixel_sigma**2 * (jacobian.mT @ value[..., None])[..., 0]
        reduced = reduced.index_add(0, columns.flatten(), pull.flatten())
    if layout.reduced is not None:
        which = layout.reduced_points
        reduced = reduced.index_add(0, layout.point_columns(which).flatten(), points[which].flatten())
        points = points[layout.eliminated_points]
    return torch.cat((reduced[:-1], points.flatten()))


class _Solve(torch.autograd.Function):
    """x = A^-1 b for a symmetric A without a gradient."""

    @staticmethod
    def forward(
        ctx: Any,
        right: Float[Tensor, " unknowns"],
        solve: Callable[[Float[Tensor, " unknowns"]], Float[Tensor, " unknowns"]],
    ) -> Float[Tensor, " unknowns"]:
        ctx.solve = solve
        return torch.zeros_like(right)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] - the decorator hides the names
        ctx: Any, *gradients: Float[Tensor, " unknowns"]
    ) -> tuple[Float[Tensor, " unknowns"], None]:
        return ctx.solve(gradients[0]), None
