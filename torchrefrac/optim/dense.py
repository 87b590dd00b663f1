"""The reduced system solved by a dense Cholesky factorisation: to the last weak mode, up to some thousand unknowns."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.normal_equations import NormalEquations


def solve_dense(elimination: Elimination) -> tuple[Float[Tensor, " size"], Bool[Tensor, ""]]:
    """Step of the damped reduced system, and whether there is one; zero where there is not.

    Unknowns that nothing depends on stand still.
    """
    system = elimination.system
    matrix, negative = elimination.reduced()
    matrix.diagonal().add_(elimination.damping * system.diagonal)
    scale, _ = prepare(matrix, system)
    factor, info = torch.linalg.cholesky_ex(matrix)
    solution = -torch.cholesky_solve((negative * scale)[:, None], factor)[:, 0] * scale
    pivot = factor.diagonal().square().amin()  # of a matrix with a unit diagonal
    solved = (info == 0) & (pivot > len(factor) * torch.finfo(factor.dtype).eps) & solution.isfinite().all()
    return torch.where(solved, solution, 0.0), solved


def prepare(
    matrix: Float[Tensor, "size size"], system: NormalEquations
) -> tuple[Float[Tensor, " size"], Float[Tensor, ""]]:
    """Make a reduced matrix of `system` one that has a Cholesky factor, in place: S A S with a unit diagonal.

    Unknowns that nothing depends on get the diagonal 1; directions of the null space are made as stiff as the unknowns
    are that they move. Returns S and that stiffness.
    """
    diagonal = matrix.diagonal()
    diagonal.copy_(torch.where(system.dead, 1.0, diagonal))
    stiffness = diagonal.new_ones(())
    null_space = system.null_space
    if null_space is not None:
        stiffness = (null_space.square().T @ diagonal).mean()
        matrix.addmm_(null_space * stiffness, null_space.T)
    scale = diagonal.clamp(min=torch.finfo(matrix.dtype).tiny).rsqrt()
    matrix.mul_(scale[:, None]).mul_(scale)
    return scale, stiffness
