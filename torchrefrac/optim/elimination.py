"""The eliminated blocks taken out of the normal equations at one damping.

With X_i V_i X_i^T = I for every (damped) eliminated block and Z = X E^T, the reduced system is

    (B - Z^T Z) dc = -gc + Z^T X gp,        dp = -X^T (X gp + Z dc).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.numerics import columns_at, inverse_cholesky_components
from torchrefrac.optim.normal_equations import LOWER, NormalEquations, in_cache
from torchrefrac.optim.plan import ELIMINATED_SIZE, REDUCED_SIZE, TILE, Chunk, Family

BLOCK = REDUCED_SIZE * REDUCED_SIZE
Places = Float[Tensor, "3 places"]
Rows = Float[Tensor, "residuals row k"]
Slim = Float[Tensor, "3 residuals k"]


class Tiles(NamedTuple):
    """Z of a chunk of tiles, rows of 3 TILE: in the unknowns of the reduced blocks that they meet, and in those of all
    families."""

    chunk: Chunk
    by_block: Float[Tensor, "tiles rows own"]
    by_shared: Float[Tensor, "tiles rows shared"]


class Products(NamedTuple):
    """Z^T Z of pairs of reduced blocks, row by row, complete where the id of the first is not below that of the second;
    of reduced blocks and shared unknowns; and of these. gradient: of the reduced system."""

    by_pair: Float[Tensor, "pairs 36"]
    mixed: Float[Tensor, "own shared"]
    shared: Float[Tensor, "shared shared"]
    gradient: Float[Tensor, " size"]


@dataclass(frozen=True)
class Elimination:
    """`system` with the Hessian of every eliminated block raised by `damping` times its diagonal."""

    system: NormalEquations
    damping: float

    @cached_property
    def factor(self) -> Float[Tensor, "6 places"]:
        """X: lower triangles."""
        lift = [1.0 + self.damping if i == j else 1.0 for i, j in LOWER]
        return torch.stack(
            inverse_cholesky_components([h * by for h, by in zip(self.system.eliminated_hessian, lift, strict=True)])
        )

    @cached_property
    def whitened(self) -> Places:
        """X gp."""
        return _lower_times(self.factor, self.system.eliminated_gradient)

    def tiles(self) -> Iterator[Tiles]:
        """Chunk by chunk. One buffer serves all: use one before asking for the next."""
        plan = self.system.plan
        largest = max((len(c.reduced) * TILE * c.reduced.shape[1] for c in plan.chunks), default=0)
        buffer = self.factor.new_empty(largest * ELIMINATED_SIZE, REDUCED_SIZE)
        for chunk in plan.chunks:
            rows = self.system.rows[..., chunk.observations]
            slim = self._whitened_rows(chunk, rows)
            z = _outer(slim, rows[:, plan.layout.block]).flatten(0, 1).T.reshape(-1, REDUCED_SIZE)
            across = chunk.reduced.shape[1]
            here = buffer[: len(chunk.reduced) * TILE * ELIMINATED_SIZE * across].zero_()
            step = across * torch.arange(ELIMINATED_SIZE, device=z.device)
            here.index_copy_(0, (chunk.slot[:, None] + step).flatten(), z)
            by_block = here.view(-1, ELIMINATED_SIZE * TILE, across * REDUCED_SIZE)
            yield Tiles(chunk, by_block, self._shared_part(chunk, slim, rows))

    def reduced(self) -> tuple[Float[Tensor, "size size"], Float[Tensor, " size"]]:
        """The reduced system, undamped in the reduced unknowns: the lower triangle of its matrix, and -rhs."""
        plan, m, g = self.system.plan, self.system.plan.num_reduced, self.system.plan.num_shared
        by_pair, across, shared, gradient = self.products((m + 1) * (m + 1), plan.codes)
        matrix = self.system.dense()
        first, end = REDUCED_SIZE * m, REDUCED_SIZE * m + g
        square = matrix[:first, :first].view(m, REDUCED_SIZE, m, REDUCED_SIZE)
        square -= by_pair.view(m + 1, m + 1, REDUCED_SIZE, REDUCED_SIZE)[:m, :m].transpose(1, 2)
        matrix[first:end, :first] -= across.T
        matrix[first:end, first:end] -= shared
        return matrix, gradient

    def products(self, pairs: int, slots: Callable[[Chunk], Int[Tensor, "tiles width width"]]) -> "Products":
        """Z^T Z, chunk by chunk. slots: which of so many pairs those of the blocks of each tile are."""
        m, g = self.system.plan.num_reduced, self.system.plan.num_shared
        by_pair = self.factor.new_zeros(pairs, BLOCK)
        mixed = self.factor.new_zeros(m + 1, REDUCED_SIZE * (g + 1))
        shared = self.factor.new_zeros(g + 1, g + 1)
        for chunk, z, z_shared in self.tiles():
            whitened = self.whitened[:, chunk.tiles.start * TILE : chunk.tiles.stop * TILE].T.reshape(len(z), -1, 1)
            rest = torch.cat((z_shared, whitened), dim=-1)
            _add_products(by_pair, z, slots(chunk))
            across = z.mT @ rest if g else (rest.mT @ z).mT  # of one column the latter is several times as fast
            across = across.reshape(-1, mixed.shape[1])
            mixed.index_add_(0, chunk.reduced.flatten(), across)
            flat = rest.flatten(0, 1)
            shared.addmm_(flat.T, flat)
        first, end = REDUCED_SIZE * m, REDUCED_SIZE * m + g
        by_block, gradient = mixed[:m].reshape(first, g + 1), self.system.gradient.clone()
        gradient[:first] -= by_block[:, g]
        gradient[first:end] -= shared[:g, g]
        return Products(by_pair, by_block[:, :g], shared[:g, :g], gradient)

    def to_eliminated(self, x: Float[Tensor, " size"]) -> Places:
        """E^T x."""
        plan, rows, layout = self.system.plan, self.system.rows, self.system.plan.layout
        local = x[plan.columns].T.contiguous()
        total = self.factor.new_zeros(ELIMINATED_SIZE, plan.num_places)
        for here in in_cache(rows.shape[-1]):
            at = columns_at(local, plan.reduced[here])
            moved = (rows[:, layout.reduced, here] * at).sum(dim=1, keepdim=True)
            total.index_add_(1, plan.place[here], (rows[:, layout.eliminated, here] * moved).sum(dim=0))
        return total

    def to_reduced(self, y: Places) -> Float[Tensor, " size"]:
        """E y."""
        plan, rows, layout = self.system.plan, self.system.rows, self.system.plan.layout
        local = self.factor.new_zeros(plan.columns.shape[1], plan.num_reduced)
        for here in in_cache(rows.shape[-1]):
            at = columns_at(y, plan.place[here])
            moved = (rows[:, layout.eliminated, here] * at).sum(dim=1, keepdim=True)
            local.index_add_(1, plan.reduced[here], (rows[:, layout.reduced, here] * moved).sum(dim=0))
        return y.new_zeros(plan.size).index_add_(0, plan.columns.T.flatten(), local.flatten())

    def back_substitute(self, x: Float[Tensor, " size"]) -> Places:
        """The step of the eliminated blocks for the step x of the reduced unknowns."""
        if self.system.rows.shape[-1] == 0:
            return self.whitened
        pulled = self.whitened + _lower_times(self.factor, self.to_eliminated(x))
        return -_upper_times(self.factor, pulled)

    def times_inverse(self, y: Places) -> Places:
        """V^-1 y."""
        return _upper_times(self.factor, _lower_times(self.factor, y))

    def _whitened_rows(self, chunk: Chunk, rows: Rows) -> Slim:
        """J_p X^T."""
        plan = self.system.plan
        x00, x10, x11, x20, x21, x22 = columns_at(self.factor, plan.place[chunk.observations])
        p0, p1, p2 = rows[:, plan.layout.eliminated].unbind(dim=1)
        return torch.stack((p0 * x00, p0 * x10 + p1 * x11, p0 * x20 + p1 * x21 + p2 * x22))

    def _shared_part(self, chunk: Chunk, slim: Slim, rows: Rows) -> Float[Tensor, "tiles rows shared"]:
        plan, here = self.system.plan, chunk.observations
        tiles, places = len(chunk.reduced), len(chunk.reduced) * TILE
        place = plan.place[here] - chunk.tiles.start * TILE
        parts = [
            _summed(_outer(slim, rows[:, part]), place, plan.reduced[here], family, places)
            for family, part in zip(plan.families, plan.layout.shared, strict=True)
        ]
        if not parts:
            return slim.new_zeros(tiles, ELIMINATED_SIZE * TILE, 0)
        return torch.cat(parts, dim=-1).reshape(tiles, ELIMINATED_SIZE * TILE, -1)


def _summed(
    by: Float[Tensor, "3 size k"], place: Int[Tensor, " k"], reduced: Int[Tensor, " k"], family: Family, places: int
) -> Float[Tensor, "places 3 shared"]:
    """Summed over the observations of each eliminated block that share a member of the family, members side by side."""
    member = place if family.count == 1 else place * family.count + family.member[reduced]
    total = by.new_zeros(ELIMINATED_SIZE * family.size, places * family.count)
    total.index_add_(1, member, by.flatten(0, 1))
    return total.view(ELIMINATED_SIZE, family.size, places, family.count).permute(2, 0, 3, 1).flatten(2)


def _outer(slim: Slim, rows: Float[Tensor, "residuals size k"]) -> Float[Tensor, "3 size k"]:
    """Sum of products over the residuals."""
    total = slim[:, 0, None] * rows[None, 0]
    for r in range(1, len(rows)):
        total.addcmul_(slim[:, r, None], rows[None, r])
    return total


def _add_products(
    by_pair: Float[Tensor, "pairs 36"], z: Float[Tensor, "tiles rows own"], slot: Int[Tensor, "tiles width width"]
) -> None:
    """Add the 6x6 blocks of Z^T Z to those of pairs of reduced blocks: none is left out in the lower triangle. Their
    ids ascend along a tile, so that a strip of rows needs only the columns up to its own."""
    across = slot.shape[1]
    bounds = sorted({0, across // 2, across})
    for first, end in pairwise(bounds):
        strip = z[..., first * REDUCED_SIZE : end * REDUCED_SIZE].mT @ z[..., : end * REDUCED_SIZE]
        blocks = strip.view(-1, end - first, REDUCED_SIZE, end, REDUCED_SIZE).transpose(2, 3).reshape(-1, BLOCK)
        by_pair.index_add_(0, slot[:, first:end, :end].flatten(), blocks)


def _lower_times(x: Float[Tensor, "6 n"], y: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """X y for lower triangles X."""
    return torch.stack((x[0] * y[0], x[1] * y[0] + x[2] * y[1], x[3] * y[0] + x[4] * y[1] + x[5] * y[2]))


def _upper_times(x: Float[Tensor, "6 n"], y: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """X^T y."""
    return torch.stack((x[0] * y[0] + x[1] * y[1] + x[3] * y[2], x[2] * y[1] + x[4] * y[2], x[5] * y[2]))
