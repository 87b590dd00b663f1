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
from torchrefrac.optim.blocks import ReducedBlocks
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
    clusters = Clusters.of(system, options.cluster)
    pairs = system.pairs
    formed = REDUCED_SIZE**2 * len(pairs) <= system.rows.numel()
    if not formed:
        together = clusters.has(*clusters.position[REDUCED_SIZE * pairs].T)
        pairs = pairs[together]
    blocks = ReducedBlocks.of(elimination, pairs)

    def times(x: Vector) -> Vector:
        eliminated = elimination.to_reduced(elimination.times_inverse(elimination.to_eliminated(x)))
        return system.apply(x) + lift * x - eliminated

    multiply = blocks.times if formed else times
    precondition = _preconditioner(blocks, clusters, (system.diagonal + lift).sqrt(), coarse, multiply)
    right = -blocks.gradient
    x = conjugate_gradients(multiply, precondition, right, options.tolerance, options.max_iterations, options.forcing)
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
    ended = size <= tolerance**2 * start
    for iteration in range(1, max_iterations + 1):
        if bool(ended):  # one look at a GPU
            break
        along = times(direction)
        bend = direction @ along
        length = size / bend
        last = length * size
        gain = gain + last
        x, residual = torch.where(bend > 0.0, x + length * direction, x), residual - length * along
        z = precondition(residual)
        before, size = size, residual @ z
        direction = z + (size / before) * direction
        ended = (size <= tolerance**2 * start) | (iteration * last < forcing * gain) | ~(bend > 0.0)
    return x


def _preconditioner(
    blocks: ReducedBlocks, clusters: Clusters, root: Vector, coarse: Coarse, times: Operator
) -> Operator:
    """x -> D^-1 x + W (W^T S W)^-1 W^T x, where D is made of clusters. root: units of the unknowns, in which B has a
    unit diagonal."""
    first, size = REDUCED_SIZE * len(blocks.own), len(root)
    place, filled = clusters.position[:first], clusters.count * clusters.width
    numbers, last = blocks.laid_out(clusters), torch.arange(first, filled, device=place.device)
    numbers[clusters.address(last, last)] = 1.0
    factor = torch.linalg.cholesky_ex(numbers.view(clusters.count, clusters.width, clusters.width))[0]
    rest = root[first:].square().reciprocal()
    shared = torch.zeros(size, size - first, dtype=root.dtype, device=root.device)
    shared[first:] = torch.eye(size - first, dtype=root.dtype, device=root.device)
    basis, small = shared if coarse is None else torch.cat((coarse, shared), dim=1), root.new_zeros(0, 0)
    if basis.shape[1]:
        basis = torch.linalg.qr(basis * root[:, None]).Q / root[:, None]
        product = torch.stack([times(column) for column in basis.T], dim=1)
        values, vectors = torch.linalg.eigh(torch.nan_to_num(basis.T @ product, 0.0, 0.0, 0.0))
        rounding = len(values) * torch.finfo(values.dtype).eps
        small = vectors * torch.where(values > rounding, values.reciprocal(), 0.0) @ vectors.T

    def apply(x: Vector) -> Vector:
        at = x.new_zeros(filled).index_copy_(0, place, x[:first]).view(clusters.count, -1, 1)
        own = torch.cholesky_solve(at, factor).flatten()[place]
        local = torch.cat((own, rest * x[first:]))
        return local + basis @ (small @ (basis.T @ x)) if basis.shape[1] else local

    return apply
