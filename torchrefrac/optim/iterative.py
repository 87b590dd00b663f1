"""The reduced system solved by conjugate gradients, without forming it: for many reduced blocks.

The preconditioner is the reduced system's own block diagonal (Schur-Jacobi), and beside it a coarse correction: the
system restricted to a few directions in which all blocks move together. Where such directions are weak - everything can
move in them at next to no cost - they converge very slowly block by block.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.checks import Range, require_ranges
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.plan import REDUCED_SIZE

Vector = Float[Tensor, " size"]
Coarse = Float[Tensor, "size directions"] | None
Operator = Callable[[Vector], Vector]


@dataclass(frozen=True)
class IterativeOptions:
    """Stop when the residual has fallen to `tolerance` of the right side, in the preconditioner's norm."""

    tolerance: float = 1e-6
    max_iterations: int = 500

    def __post_init__(self) -> None:
        bounds = {"tolerance": Range(at_least=0.0, at_most=1.0), "max_iterations": Range(at_least=1, at_most=1_000_000)}
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
    precondition = _preconditioner(elimination, lift, coarse, times)
    x = conjugate_gradients(times, precondition, right, options.tolerance, options.max_iterations)
    solved = x.isfinite().all() & (x.any() | ~right.any())
    return torch.where(solved, x, 0.0), solved


def conjugate_gradients(
    times: Operator, precondition: Operator, right: Vector, tolerance: float, max_iterations: int
) -> Vector:
    """x with A x = right, or as near as it came: the search ends when the residual has fallen to `tolerance` of
    the right side in the preconditioner's norm, or where A turns out not to be positive definite."""
    x = torch.zeros_like(right)
    residual, z = right, precondition(right)
    direction = z
    size = start = residual @ z
    for _ in range(max_iterations):
        if bool(size <= tolerance**2 * start):
            break
        along = times(direction)
        bend = direction @ along
        if not bool(bend > 0.0):
            break
        length = size / bend
        x, residual = x + length * direction, residual - length * along
        z = precondition(residual)
        before, size = size, residual @ z
        direction = z + (size / before) * direction
    return x


def _preconditioner(elimination: Elimination, lift: Vector, coarse: Coarse, times: Operator) -> Operator:
    """x -> D^-1 x + W (W^T S W)^-1 W^T x."""
    system, plan = elimination.system, elimination.system.plan
    first = REDUCED_SIZE * plan.num_reduced
    blocks = _block_diagonal(elimination, lift)
    factor = torch.linalg.cholesky_ex(blocks)[0]
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
        own = torch.cholesky_solve(x[:first].view(-1, REDUCED_SIZE, 1), factor).flatten()
        local = torch.cat((own, rest * x[first:]))
        return local + basis @ (small @ (basis.T @ x)) if basis.shape[1] else local

    return apply


def _block_diagonal(elimination: Elimination, lift: Vector) -> Float[Tensor, "blocks 6 6"]:
    """The 6x6 diagonal blocks of the damped reduced system."""
    system, m = elimination.system, elimination.system.plan.num_reduced
    first = REDUCED_SIZE * m
    blocks = lift.new_zeros(m + 1, REDUCED_SIZE, REDUCED_SIZE)
    for chunk, z, _ in elimination.tiles():
        by_block = z.unflatten(-1, (chunk.reduced.shape[1], REDUCED_SIZE)).transpose(1, 2).flatten(0, 1)
        blocks.index_add_(0, chunk.reduced.flatten(), by_block.mT @ by_block, alpha=-1.0)
    own = blocks[:m]
    for columns, hessian, _ in system.blocks:
        of = columns // REDUCED_SIZE
        k, i, j = ((of[:, :, None] == of[:, None, :]) & (columns[:, :, None] < first)).nonzero().T
        row, column = columns[k, i], columns[k, j]
        own.view(-1).index_add_(0, row * REDUCED_SIZE + column % REDUCED_SIZE, hessian[k, i, j])
    return own + torch.diag_embed(lift[:first].view(m, REDUCED_SIZE))
