"""The reduced system solved by conjugate gradients, without forming it: for many reduced blocks.

The preconditioner takes clusters of neighbouring blocks exactly, each without the others (Kushal and Agarwal,
"Visibility based preconditioning for bundle adjustment", 2012), and beside them a coarse correction: the system
restricted to a few directions in which all blocks move together. Where such directions are weak - everything can move
in them at next to no cost - they converge very slowly block by block.

A step need not be exact: the next one starts from another linearisation. The search ends where going on promises little
(Nash and Sofer, "Assessing a search direction within a truncated-Newton method", 1990): where the last iteration
lowered the quadratic model by less than the share `forcing` of what all of them did in the mean.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.checks import Range, require_ranges
from torchrefrac.optim.assembly import assemble
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.ordering import Clusters
from torchrefrac.optim.plan import REDUCED_SIZE

Vector = Float[Tensor, " size"]
Coarse = Float[Tensor, "size directions"] | None
Operator = Callable[[Vector], Vector]


@dataclass(frozen=True)
class IterativeOptions:
    """Stop when the residual has fallen to `tolerance` of the right side, in the preconditioner's norm, or when an
    iteration lowers the quadratic model by less than `forcing` of what all did in the mean (0: never). cluster: how
    many reduced blocks the preconditioner takes together."""

    tolerance: float = 1e-6
    max_iterations: int = 500
    forcing: float = 0.1
    cluster: int = 100

    def __post_init__(self) -> None:
        bounds = {
            "tolerance": Range(at_least=0.0, at_most=1.0),
            "max_iterations": Range(at_least=1, at_most=1_000_000),
            "forcing": Range(at_least=0.0, at_most=1.0),
            "cluster": Range(at_least=1, at_most=1000),
        }
        require_ranges(self, bounds)


def solve_iteratively(
    elimination: Elimination, coarse: Coarse, options: IterativeOptions
) -> tuple[Vector, Bool[Tensor, ""]]:
    """Step of the damped reduced system, and whether there is one; zero where there is not.

    coarse: directions taken exactly. A search that ends early, for want of iterations or because the system
    turns out not to be positive definite, has a step that lowers the quadratic model, if only a part of the way.
    """
    system, damping = elimination.system, elimination.damping
    lift = torch.where(system.dead, 1.0, damping * system.diagonal)

    def times(x: Vector) -> Vector:
        eliminated = elimination.to_reduced(elimination.times_inverse(elimination.to_eliminated(x)))
        return system.apply(x) + lift * x - eliminated

    right = elimination.to_reduced(elimination.times_inverse(system.eliminated_gradient)) - system.gradient
    precondition = _preconditioner(elimination, lift, coarse, options.cluster, times)
    x = conjugate_gradients(times, precondition, right, options.tolerance, options.max_iterations, options.forcing)
    solved = x.isfinite().all() & (x.any() | ~right.any())
    return torch.where(solved, x, 0.0), solved


def conjugate_gradients(
    times: Operator, precondition: Operator, right: Vector, tolerance: float, max_iterations: int, forcing: float = 0.0
) -> Vector:
    """x with A x = right, or as near as it came: the search ends when the residual has fallen to `tolerance` of
    the right side in the preconditioner's norm, when an iteration gains less than `forcing` of the mean one, or where A
    turns out not to be positive definite."""
    x = torch.zeros_like(right)
    residual, z = right, precondition(right)
    direction = z
    size = start = residual @ z
    gain = last = torch.zeros_like(size)
    for iteration in range(max_iterations):
        if bool((size <= tolerance**2 * start) | (iteration * last < forcing * gain)):
            break
        along = times(direction)
        bend = direction @ along
        if not bool(bend > 0.0):
            break
        length = size / bend
        last = length * size
        gain = gain + last
        x, residual = x + length * direction, residual - length * along
        z = precondition(residual)
        before, size = size, residual @ z
        direction = z + (size / before) * direction
    return x


def _preconditioner(elimination: Elimination, lift: Vector, coarse: Coarse, cluster: int, times: Operator) -> Operator:
    """x -> D^-1 x + W (W^T S W)^-1 W^T x, where D is made of clusters."""
    system, plan = elimination.system, elimination.system.plan
    first = REDUCED_SIZE * plan.num_reduced
    clusters = Clusters.of(system, cluster)
    numbers, _ = assemble(elimination, clusters)
    place = clusters.position[:first]
    filled = torch.arange(first, clusters.count * clusters.width, device=place.device)
    numbers.index_add_(0, clusters.address(place, place), lift[:first])
    numbers[clusters.address(filled, filled)] = 1.0
    factor = torch.linalg.cholesky_ex(numbers.view(clusters.count, clusters.width, clusters.width))[0]
    rest = (system.diagonal + lift)[first:].reciprocal()
    if coarse is None:
        coarse = lift.new_zeros(plan.size, 0)
    shared = torch.zeros(plan.size, plan.size - first, dtype=lift.dtype, device=lift.device)
    shared[first:] = torch.eye(plan.size - first, dtype=lift.dtype, device=lift.device)
    basis, small = torch.cat((coarse, shared), dim=1), lift.new_zeros(0, 0)
    if basis.shape[1]:
        root = (system.diagonal + lift).sqrt()[:, None]  # in units in which B has a unit diagonal
        basis = torch.linalg.qr(basis * root).Q / root
        product = torch.stack([times(column) for column in basis.T], dim=1)
        values, vectors = torch.linalg.eigh(torch.nan_to_num(basis.T @ product, 0.0, 0.0, 0.0))
        rounding = len(values) * torch.finfo(values.dtype).eps
        small = vectors * torch.where(values > rounding, values.reciprocal(), 0.0) @ vectors.T

    def apply(x: Vector) -> Vector:
        at = x.new_zeros(clusters.count * clusters.width).index_copy_(0, place, x[:first])
        own = torch.cholesky_solve(at.view(clusters.count, -1, 1), factor).flatten()[place]
        local = torch.cat((own, rest * x[first:]))
        return local + basis @ (small @ (basis.T @ x)) if basis.shape[1] else local

    return apply
