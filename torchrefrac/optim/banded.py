"""The reduced system as a block tridiagonal matrix with a border, for reduced blocks that meet few others each: as
exact as the dense one, at a cost that grows with their number as such.

Section by section the matrix is factorised: L L^T is the diagonal block of a panel, what is below it follows by
substitution, and its square is taken from the next section and from the corner. Only the panels are ever there, about
as many numbers as blocks of the matrix that are not zero.

A null space N, with the stiffness k, fills the whole matrix. It is kept out of it by multipliers y = k N^T x:

    [ A      C     N_a  ] [a]                so that y has negative pivots, and is eliminated between the sections
    [ C^T    F     N_c  ] [c]                (a) and the border (c), in which some of the blocks are that N moves.
    [ N_a^T  N_c^T -1/k ] [y],

Of the inverse the panels are enough (Takahashi et al., "Formation of a sparse bus impedance matrix", 1973): with what
is below L in a panel divided by it, Y, and the inverse R among the unknowns of these rows, it is -R Y below the
diagonal block and (L L^T)^-1 + Y^T R Y in it, from the last section to the first.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.optim.blocks import ReducedBlocks
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.factor import SingularError, step_of, stiffness_of
from torchrefrac.optim.normal_equations import NormalEquations
from torchrefrac.optim.ordering import BandedOrder


def solve_banded(elimination: Elimination) -> tuple[Float[Tensor, " size"], Bool[Tensor, ""]]:
    """Step of the damped reduced system, see `step_of`."""
    return step_of(BandedFactor.of(elimination, BandedOrder.of(elimination.system)))


@dataclass(frozen=True)
class BandedFactor:
    """See `Factor`. numbers: L, in the layout of the matrix, but for the corner: there L S L^T with signs S."""

    order: BandedOrder
    numbers: Float[Tensor, " elements"]
    root: Float[Tensor, " size"]
    stiffness: Float[Tensor, ""]
    gradient: Float[Tensor, " size"]
    definite: Bool[Tensor, ""]
    pivot: Float[Tensor, ""]

    @classmethod
    def of(cls, elimination: Elimination, order: BandedOrder) -> "BandedFactor":
        """In that order of the unknowns."""
        system, position = elimination.system, order.position
        blocks = ReducedBlocks.of(elimination)
        numbers, diagonal = blocks.laid_out(order), blocks.diagonal
        stiffness = diagonal.new_ones(())
        if (null_space := system.null_space) is not None:
            stiffness = stiffness_of(null_space, diagonal)
            multiplier = order.inner + torch.arange(order.multipliers, device=position.device)
            numbers[order.address(position[:, None], multiplier)] = null_space
            numbers[order.address(multiplier, multiplier)] = -1.0 / stiffness
            diagonal = diagonal + stiffness * null_space.square().sum(dim=1)
        definite = _factorise(order, numbers)
        on_diagonal = order.address(position, position)
        pivot = (numbers[on_diagonal].square() / diagonal).amin()
        root = diagonal.clamp(min=torch.finfo(diagonal.dtype).tiny).sqrt()
        return cls(order, numbers, root, stiffness, blocks.gradient, definite, pivot)

    def solve(self, right: Float[Tensor, "size k"]) -> Float[Tensor, "size k"]:
        order = self.order
        vectors = right.new_zeros(len(right) + order.multipliers, right.shape[1])
        vectors[order.position] = right
        panels = list(order.panels(self.numbers))
        for section, panel in panels:
            own = vectors[section.own]
            own.copy_(torch.linalg.solve_triangular(panel[: section.size], own, upper=False))
            after, border = panel[section.size :].split((section.after, order.border))
            vectors[section.own.stop : section.own.stop + section.after] -= after @ own
            vectors[order.inner :] -= border @ own
        corner, last = order.corner(self.numbers), vectors[order.inner :]
        last.copy_(torch.linalg.solve_triangular(corner, last, upper=False))
        last[: order.multipliers] *= -1.0
        last.copy_(torch.linalg.solve_triangular(corner.T, last, upper=True))
        for section, panel in reversed(panels):
            own = vectors[section.own]
            own -= panel[section.size :].T @ order.below(section, vectors)
            own.copy_(torch.linalg.solve_triangular(panel[: section.size].T, own, upper=True))
        return vectors[order.position]

    def covariance(self, system: NormalEquations) -> "BandedCovariance":
        order, position = self.order, self.order.position
        inverse = torch.empty_like(self.numbers)
        corner = order.corner(inverse)
        corner.copy_(_corner_inverse(order.corner(self.numbers), order.multipliers))
        among = corner
        panels = zip(order.panels(self.numbers), order.panels(inverse), strict=True)
        for (section, panel), (_, out) in reversed(list(panels)):
            lower, below = panel.tensor_split((section.size,))
            by = torch.linalg.solve_triangular(lower, below, upper=False, left=False)
            out[section.size :] = -among @ by
            out[: section.size] = torch.cholesky_inverse(lower) - by.T @ out[section.size :]
            own, beside = out[: section.size], out[section.size + section.after :]
            among = torch.cat((torch.cat((own, beside.T), dim=1), torch.cat((beside, corner), dim=1)))
        found = BandedCovariance(order, inverse)
        if (null_space := system.null_space) is not None:
            found = found.plus(null_space.T, -1.0 / self.stiffness)
        numbers = found.numbers
        on_diagonal = order.address(position, position)
        numbers[on_diagonal] = torch.where(system.dead, 0.0, numbers[on_diagonal])
        return found


@dataclass(frozen=True)
class BandedCovariance:
    """See `ReducedCovariance`. numbers: in the layout of the matrix."""

    order: BandedOrder
    numbers: Float[Tensor, " elements"]

    def matrix(self) -> Float[Tensor, "size size"]:
        raise SingularError(f"the covariance of {len(self.order.position)} reduced unknowns is there in part only")

    def __getitem__(self, pair: tuple[Int[Tensor, "..."], Int[Tensor, "..."]]) -> Float[Tensor, "..."]:
        rows, columns = (self.order.position[of] for of in pair)
        return self.numbers[self.order.address(rows, columns)]

    def times(self, factor: float) -> "BandedCovariance":
        return replace(self, numbers=self.numbers * factor)

    def plus(
        self, draws: Float[Tensor, "draws size"], weight: float | Float[Tensor, ""] | None = None
    ) -> "BandedCovariance":
        order, numbers = self.order, self.numbers.clone()
        vectors = draws.new_zeros(draws.shape[1] + order.multipliers, len(draws))
        vectors[order.position] = draws.T
        weighed = vectors * (1.0 / len(draws) if weight is None else weight)
        for section, panel in order.panels(numbers):
            rows = torch.cat((weighed[section.own], order.below(section, weighed)))
            panel.addmm_(rows, vectors[section.own].T)
        order.corner(numbers).addmm_(weighed[order.inner :], vectors[order.inner :].T)
        return replace(self, numbers=numbers)


def _factorise(order: BandedOrder, numbers: Float[Tensor, " elements"]) -> Bool[Tensor, ""]:
    """In place; whether there is a factor."""
    corner, panels = order.corner(numbers), list(order.panels(numbers))
    definite = torch.ones((), dtype=torch.bool, device=numbers.device)
    for index, (section, panel) in enumerate(panels):
        own, below = panel.tensor_split((section.size,))
        lower, info = torch.linalg.cholesky_ex(own)
        own.copy_(lower)
        definite &= info == 0
        below.copy_(torch.linalg.solve_triangular(lower.T, below, upper=True, left=False))
        after, border = below.tensor_split((section.after,))
        corner.addmm_(border, border.T, alpha=-1.0)
        if section.after:
            following, rows = panels[index + 1]
            rows[: following.size].addmm_(after, after.T, alpha=-1.0)
            rows[following.size + following.after :].addmm_(border, after.T, alpha=-1.0)
    g = order.multipliers
    multipliers, info = torch.linalg.cholesky_ex(-corner[:g, :g])
    across = -torch.linalg.solve_triangular(multipliers.T, corner[g:, :g], upper=True, left=False)
    border, others = torch.linalg.cholesky_ex(corner[g:, g:] + across @ across.T)
    corner[:g, :g], corner[g:, :g], corner[g:, g:] = multipliers, across, border
    return definite & (info == 0) & (others == 0)


def _corner_inverse(corner: Float[Tensor, "border border"], multipliers: int) -> Float[Tensor, "border border"]:
    """Of L S L^T, where S is negative for the multipliers, which come first."""
    identity = torch.eye(len(corner), dtype=corner.dtype, device=corner.device)
    inverse = torch.linalg.solve_triangular(corner, identity, upper=False)
    signed = inverse.clone()
    signed[:multipliers] *= -1.0
    return inverse.T @ signed
