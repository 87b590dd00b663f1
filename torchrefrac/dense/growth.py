"""Patches that grow over their reference image: from cell to neighbouring cell, all at once (PMVS's expansion).

A cell beside one that has a patch supposes that patch's plane to go on. Every wave takes all such cells of the image.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.refine import Planes, refine
from torchrefrac.dense.scope import Scope

AROUND = ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
TRIES = 3


class Cells:
    """The cells of a tile: which plane each has, and what has been tried. Flat tables over rows x columns."""

    def __init__(self, scope: Scope, cell: int) -> None:
        centers = scope.centers(cell)
        self.rows, self.columns = centers.shape[:2]
        self.pixels = centers.reshape(-1, 2)
        count = len(self.pixels)
        device = scope.device
        self.origin = torch.tensor(scope.tile[:2], device=device) // cell
        self.cell = cell
        self._told = 0
        self.filled = torch.zeros(count, dtype=torch.bool, device=device)
        self.score = torch.full((count,), -1.0, dtype=torch.float64, device=device)
        self.points = torch.zeros(count, 3, dtype=torch.float64, device=device)
        self.normals = torch.zeros(count, 3, dtype=torch.float64, device=device)
        self.tries = torch.zeros(count, dtype=torch.long, device=device)
        self.tried_score = torch.full(
            (count,), -1.0, dtype=torch.float64, device=device
        )  # the best plane that has failed here

    def index(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Cells (N) that pixels (N, 2) lie in, and which lie in one (N)."""
        at = (pixels / self.cell).floor().long() - self.origin
        column, row = at.unbind(dim=-1)
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return torch.where(inside, row * self.columns + column, 0), inside

    def fill(self, cells: Tensor, points: Tensor, normals: Tensor, score: Tensor) -> None:
        """Where several planes (k) come to one cell, the best stays."""
        order = score.argsort(stable=True)
        order = order[cells[order].argsort(stable=True)]
        best = torch.ones_like(order, dtype=torch.bool)
        best[:-1] = cells[order[1:]] != cells[order[:-1]]
        rows = order[best]
        rows = rows[score[rows] > self.score[cells[rows]]]
        at = cells[rows]
        self.points[at], self.normals[at] = points[rows], normals[rows]
        self.score[at], self.filled[at] = score[rows], True

    def newly_filled(self) -> int:
        """How many have been filled since this was last asked."""
        before, self._told = self._told, int(self.filled.sum())
        return self._told - before

    def frontier(self) -> tuple[Tensor, Tensor]:
        """Empty cells (k) beside filled ones, and of these the one (k) whose plane is to be tried: the best.

        Only where it is better than what was tried before.
        """
        score = self.score.view(self.rows, self.columns)
        padded = torch.nn.functional.pad(score[None, None], (1, 1, 1, 1), value=-1.0)[0, 0]
        best = torch.full_like(score, -1.0)
        source = torch.zeros_like(score, dtype=torch.long)
        here = torch.arange(len(self.score), device=score.device).view(self.rows, self.columns)
        for down, right in AROUND:
            there = padded[1 + down : 1 + down + self.rows, 1 + right : 1 + right + self.columns]
            better = there > best
            best = torch.where(better, there, best)
            source = torch.where(better, here + down * self.columns + right, source)
        best = best.flatten()
        open_cells = (~self.filled) & (best > self.tried_score) & (self.tries < TRIES) & (best > 0.0)
        cells = open_cells.nonzero()[:, 0]
        self.tries[cells] += 1
        self.tried_score[cells] = best[cells]
        return cells, source.flatten()[cells]


def grow(scope: Scope, cells: Cells, options: DenseOptions) -> Iterator[Patches]:
    """Fill the cells around those that are filled, wave after wave, until nothing more fits. Yields the new patches."""
    while True:
        target, source = cells.frontier()
        if not len(target):
            return
        planes = Planes(cells.points[source], cells.normals[source])
        patches, good = refine(scope, cells.pixels[target], planes, options)
        cells.fill(target[good], patches.points, patches.normals, patches.score)
        yield patches
