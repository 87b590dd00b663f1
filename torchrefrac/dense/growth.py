"""Patches that grow over their reference image: from cell to neighbouring cell, all at once (PMVS's expansion).

A cell beside one that has a patch supposes that patch's plane to go on. Every wave takes all such cells of the image.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches, Planes
from torchrefrac.dense.refine import refine
from torchrefrac.dense.scope import Scope

TRIES = 3
RINGS = 2  # cells by which growth may step at once; a wave costs about the same, however many cells it has
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

    def filled_since(self) -> int:
        """How many have been filled since this was last asked."""
        before, self._reported = self._reported, int(self.filled.sum())
        return self._reported - before

    def frontier(self) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
        """Empty cells near filled ones, and of these the one whose plane is to be tried: the best of the next. Only
        where it is better or nearer than what was tried before."""
        score = self.score.view(1, 1, self.rows, self.columns)
        best, source = torch.full_like(self.score, UNTRIED), torch.zeros_like(self.tries)
        for ring in range(RINGS):
            found, at = torch.nn.functional.max_pool2d(score, 2 * ring + 3, 1, ring + 1, return_indices=True)
            offer = found.flatten() - ring  # a nearer plane is worth more than any farther one
            better = offer > best
            best, source = torch.where(better, offer, best), torch.where(better, at.flatten(), source)
        cells = (~self.filled & (best > self.tried) & (self.tries < TRIES)).nonzero()[:, 0]
        self.tries[cells] += 1
        self.tried[cells] = best[cells]
        return cells, source[cells]


def grow(scope: Scope, cells: Cells, options: DenseOptions) -> Iterator[Patches]:
    """Fill the cells around those that are filled, wave after wave, until nothing more fits. Yields the new patches."""
    while True:
        target, source = cells.frontier()
        if not len(target):
            return
        planes = Planes(cells.points[source], cells.normals[source])
        patches, good = refine(scope, cells.pixels[target], planes, options)
        cells.fill(target[good], patches)
        yield patches
