"""What the tests of the adjustment compare it with: residuals by the camera, derivatives by autograd, dense algebra."""

import torch
from torch import Tensor

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.rows import MEDIA
from torchrefrac.optim import Step, robust
from torchrefrac.scene import Observations, Scene


def errors_of(state: Scene, seen: Observations) -> Tensor:
    """Projection minus pixel (N, 2)."""
    return state.cameras_of(seen).project(state.points[seen.point])[0] - seen.pixels


def moved(layout: Layout, state: Scene, step: Tensor) -> Scene:
    """`state` after a step in everything (size + 3 free points)."""
    points = step[layout.size :].reshape(-1, 3)
    return layout.retract(state, Step(step[: layout.size], points, torch.zeros(()), torch.tensor(True)))


def num_unknowns(layout: Layout) -> int:
    """How long such a step is."""
    return layout.size + 3 * (layout.num_points - len(layout.reduced_points))


def jacobian_of(function, layout: Layout, state: Scene) -> Tensor:
    """Of function(state) -> (K): (K, unknowns) by autograd through the retraction; zero in what is fixed."""
    at = torch.zeros(num_unknowns(layout), dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda step: function(moved(layout, state, step)), at, vectorize=True)
    if layout.fixed is not None:
        jacobian[:, : 6 * layout.num_views] *= ~layout.fixed.flatten()
    return jacobian


def weighted_residuals(problem, observations: Observations, at: Scene):
    """The function state -> residuals (K) whose Gauss-Newton system the problem linearised at `at` must have: that of a
    quadratic with the gradient of the loss, curved by its weight across each residual, and along it by what the loss
    has there or by half the weight."""
    options, layout = problem.options, problem.layout
    error = errors_of(at, observations).detach()
    values, directions = torch.linalg.eigh(curvature_of(error, options.loss, options.loss_scale))
    root = directions * values.sqrt()[:, None] @ directions.mT
    weight = robust(error.square().sum(dim=-1), options.loss, options.loss_scale)[1]
    pull = torch.linalg.solve(root, (weight[:, None] * error)[..., None])[..., 0]

    def residuals(state: Scene) -> Tensor:
        change = errors_of(state, observations) - error
        parts = [((root @ change[..., None])[..., 0] + pull).flatten()]
        parts += [options.pixel_sigma * term.residuals(state, layout).value.flatten() for term in problem.terms]
        return torch.cat(parts)

    return residuals


def curvature_of(error: Tensor, loss, scale: float) -> Tensor:
    """(K, 2, 2): of half the loss in each error, by a loop and the derivative of the weight that autograd knows; along
    the error half the weight at least."""
    found = []
    for one in error.detach():
        s = one.square().sum().requires_grad_()
        _, weight = robust(s, loss, scale)
        (of_weight,) = torch.autograd.grad(weight, s) if weight.requires_grad else (torch.zeros(()),)
        weight, along, square = float(weight.detach()), one / one.norm().clamp(min=1e-300), float(one.square().sum())
        radial = max(weight + 2.0 * square * float(of_weight), 0.5 * weight)
        projector = torch.outer(along, along)
        found.append(radial * projector + weight * (torch.eye(2, dtype=one.dtype) - projector))
    return torch.stack(found)


def cost_by_definition(problem, observations: Observations, state: Scene) -> Tensor:
    """Half the sum of all losses, and of all squared residuals of the terms in pixels."""
    options, layout = problem.options, problem.layout
    square = errors_of(state, observations).square().sum(dim=-1)
    cost = robust(square, options.loss, options.loss_scale)[0].sum()
    for term in problem.terms:
        cost = cost + options.pixel_sigma**2 * term.residuals(state, layout).value.square().sum()
    return 0.5 * cost


def dense_jacobian(layout: Layout, observations: Observations, rows: Tensor) -> Tensor:
    """Rows (2, w + 4, N) of observations of points that are eliminated, spread over all unknowns: (2 N, unknowns)."""
    count = len(observations)
    images = torch.arange(layout.num_views)
    columns = [6 * images[:, None] + torch.arange(6)]
    columns += [layout.intrinsics_columns(name, layout.camera) for name in layout.intrinsics]
    columns += [torch.full((len(images), 1), layout.medium_column(name)) for name in MEDIA if name in layout.water]
    by_plane = layout.plane_columns(layout.interface)
    columns.append(by_plane[:, by_plane[0] != layout.size])
    point = layout.size + 3 * observations.point[:, None] + torch.arange(3)
    across = torch.cat((torch.cat(columns, dim=1)[observations.view], point), dim=1)
    jacobian = torch.zeros(count, 2, num_unknowns(layout), dtype=torch.float64)
    jacobian.scatter_(2, across[:, None].expand(-1, 2, -1), rows[:, :-1].permute(2, 0, 1))
    return jacobian.flatten(0, 1)


def dense_system(system) -> tuple[Tensor, Tensor]:
    """The whole matrix [[B, E], [E^T, V]] of normal equations and their gradient; points in the order of their ids."""
    plan, places = system.plan, system.plan.place_of
    size, count = plan.size, len(places)
    coupling = torch.zeros(plan.num_places, 3, size, dtype=torch.float64)
    blocks = torch.einsum("rpk,rwk->kpw", system.rows[:, plan.layout.eliminated], system.rows[:, plan.layout.reduced])
    for block, camera, place in zip(blocks, plan.reduced.tolist(), plan.place.tolist(), strict=True):
        coupling[place][:, plan.columns[camera]] += block
    coupling = coupling[places].flatten(0, 1)
    points = torch.zeros(count, 3, 3, dtype=torch.float64)
    i, j = torch.tril_indices(3, 3)
    points[:, i, j] = points[:, j, i] = system.eliminated_hessian.T[places]
    upper = torch.cat((system.dense(), coupling.T), dim=1)
    lower = torch.cat((coupling, torch.block_diag(*points)), dim=1)
    return torch.cat((upper, lower)), torch.cat((system.gradient, system.eliminated_gradient.T[places].flatten()))


def null_space_of(jacobian: Tensor, tolerance: float = 1e-9) -> Tensor:
    """Orthonormal basis (unknowns, k) of steps that change nothing; unknowns that nothing depends on stand still."""
    size = jacobian.norm(dim=0)
    live = size > 0
    _, singular, directions = torch.linalg.svd(jacobian[:, live] / size[live], full_matrices=True)
    nulls = directions[int((singular > tolerance * singular[0]).sum()) :].T / size[live, None]
    whole = jacobian.new_zeros(len(size), nulls.shape[1])
    whole[live] = nulls
    return torch.linalg.qr(whole).Q


def projector(basis: Tensor | None, size: int) -> Tensor:
    """Onto the span of a basis (size, k) of full rank; None spans nothing."""
    if basis is None:
        return torch.zeros(size, size, dtype=torch.float64)
    q = torch.linalg.qr(basis).Q
    return q @ q.T
