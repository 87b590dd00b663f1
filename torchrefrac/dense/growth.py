"""Patches that grow over their reference image: from cell to neighbouring cell, all at once (PMVS's expansion).

A cell beside one that has a patch supposes that patch's plane to go on.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.dense.attempts import Attempts
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches, Planes
from torchrefrac.dense.refine import advance, attempt
from torchrefrac.dense.scope import Scope

TRIES = 3
RINGS = 2  # cells by which growth may step at once
UNTRIED = -float(RINGS)  # below what any neighbour offers


class Cells:
    """The cells of a tile: which plane each has, and what has been tried. Flat tables over rows x columns."""

    def __init__(self, scope: Scope, cell: int) -> None:
        centers = scope.centers(cell)
        (self.rows, self.columns), device = centers.shape[:2], scope.device
        self.pixels = centers.reshape(-1, 2)
        count = len(self.pixels)
        self.origin = torch.tensor(scope.tile[:2], device=device) // cell
        self.cell = cell
        self._reported = 0
        self.filled = torch.zeros(count, dtype=torch.bool, device=device)
        self.score = torch.full((count,), UNTRIED, dtype=torch.float64, device=device)
        self.points = torch.zeros(count, 3, dtype=torch.float64, device=device)
        self.normals = torch.zeros(count, 3, dtype=torch.float64, device=device)
        self.tries = torch.zeros(count, dtype=torch.long, device=device)
        self.tried = self.score.clone()  # what the best plane that has failed here was worth
        self.busy = torch.zeros_like(self.filled)  # where a plane is being tried
        self._changed: list[Int[Tensor, " k"]] = []
        self.steps, self.ring = _steps(device)

    def index(self, pixels: Float[Tensor, "n 2"]) -> tuple[Int[Tensor, " n"], Bool[Tensor, " n"]]:
        """Cells that pixels lie in, and which lie in one."""
        at = (pixels / self.cell).floor().long() - self.origin
        column, row = at.unbind(dim=-1)
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return torch.where(inside, row * self.columns + column, 0), inside

    def fill(self, cells: Int[Tensor, " k"], patches: Patches) -> None:
        """With the planes of patches (k); where several come to one cell, the best stays."""
        score, order = patches.score, patches.score.argsort(stable=True)
        order = order[cells[order].argsort(stable=True)]
        best = torch.ones_like(order, dtype=torch.bool)
        best[:-1] = cells[order[1:]] != cells[order[:-1]]
        rows = order[best]
        rows = rows[score[rows] > self.score[cells[rows]]]
        at = cells[rows]
        self.points[at], self.normals[at] = patches.points[rows], patches.normals[rows]
        self.score[at], self.filled[at] = score[rows], True
        self._changed.append(at)

    def reconsider(self, cells: Int[Tensor, " k"]) -> None:
        """Where nothing is under way any more, what neighbours have to offer meanwhile counts."""
        self._changed.append(cells)

    def filled_since(self) -> int:
        """How many have been filled since this was last asked."""
        before, self._reported = self._reported, int(self.filled.sum())
        return self._reported - before

    def frontier(self) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
        """Empty cells near filled ones, and of these the one whose plane is to be tried: the best of the next. Only
        where it is better or nearer than what was tried before, and nothing is under way."""
        changed, self._changed = torch.cat([self.tries[:0], *self._changed]), []
        near = torch.zeros_like(self.filled)
        steps = self.steps[:, 0] * self.columns + self.steps[:, 1]
        around = (changed[:, None] + steps).clamp(0, len(near) - 1)
        near.index_fill_(0, torch.cat((changed, around.flatten())), value=True)  # and some across the border
        cells = (near & ~self.filled & ~self.busy & (self.tries < TRIES)).nonzero()[:, 0]
        around, inside = self._around(cells)
        offer = torch.where(inside, self.score[around] - self.ring, UNTRIED)
        best, which = offer.max(dim=1)
        better = (best > self.tried[cells]).nonzero()[:, 0]
        cells = cells[better]
        self.tries[cells] += 1
        self.tried[cells] = best[better]
        return cells, around[better, which[better]]

    def _around(self, cells: Int[Tensor, " n"]) -> tuple[Int[Tensor, "n around"], Bool[Tensor, "n around"]]:
        """The cells within `RINGS` of each, nearer ones first, and which of them lie in the tile; others count as the
        first cell."""
        row = (cells // self.columns)[:, None] + self.steps[:, 0]
        column = (cells % self.columns)[:, None] + self.steps[:, 1]
        inside = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        return torch.where(inside, row * self.columns + column, 0), inside


def grow(scope: Scope, cells: Cells, options: DenseOptions, under_way: Attempts | None = None) -> Iterator[Patches]:
    """Fill the cells of what is under way and those around filled ones, until nothing more fits. Yields new patches.

    Where one cell is filled its neighbours begin at once, beside all that is still under way.
    """
    if under_way is not None:
        cells.busy[under_way.number] = True
    while True:
        target, source = cells.frontier()
        planes = Planes(cells.points[source], cells.normals[source])
        begun = attempt(scope, target, cells.pixels[target], planes, options)
        cells.busy[begun.number] = True
        under_way = begun if under_way is None else Attempts.together([under_way, begun])
        if not len(under_way):
            return
        under_way, ended = advance(scope, under_way, options)
        cells.busy[ended.number] = False
        cells.fill(ended.good, ended.patches)
        cells.reconsider(ended.number)
        yield ended.patches


def _steps(device: torch.device) -> tuple[Int[Tensor, "around 2"], Int[Tensor, " around"]]:
    """Rows and columns from a cell to those within `RINGS`, nearer ones first, and how many rings lie between."""
    reach = torch.arange(-RINGS, RINGS + 1, device=device)
    steps = torch.cartesian_prod(reach, reach)
    ring = steps.abs().amax(dim=1)
    order = ring.argsort(stable=True)[1:]
    return steps[order], ring[order] - 1
