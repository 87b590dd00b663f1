"""The nearest others of every patch, in one piece of the ground after the other."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchrefrac.dense.patches import Patches

NEAREST = 12  # patches around one that it is judged by
REACH = 4.0  # cells within which these must lie
AT_ONCE = 1 << 15  # patches whose neighbours are looked at: those of all would take several times their memory
PIECE = 1 << 19  # patches that a piece of the ground has, about


class Vicinity(NamedTuple):
    """Some patches, the nearest others of each, and which of these are near."""

    rows: Int[Tensor, " k"]
    others: Int[Tensor, "k nearest"]
    near: Bool[Tensor, "k nearest"]


def vicinities(patches: Patches, rows: Int[Tensor, " n"], cell: int) -> Iterator[Vicinity]:
    """Of some of the patches, more than NEAREST; `rows` and `others` of what comes count among these."""
    reach = REACH * cell * float(patches.footprint[rows].max())
    for own, around in _pieces(patches.points, rows, reach):
        tree = KDTree(patches.points[rows[around]].numpy())
        for some in own.split(AT_ONCE):
            points = patches.points[rows[some]].numpy()
            distance, index = (np.asarray(found) for found in tree.query(points, k=NEAREST + 1, workers=1))
            near = torch.from_numpy(distance[:, 1:]) < REACH * cell * patches.footprint[rows[some], None]
            found = torch.from_numpy(np.minimum(index[:, 1:], len(around) - 1))  # beyond: there are no more
            yield Vicinity(some, around[found], near)


def _pieces(
    points: Float[Tensor, "all 3"], rows: Int[Tensor, " n"], reach: float
) -> Iterator[tuple[Int[Tensor, " k"], Int[Tensor, " a"]]]:
    """Squares of the ground: which of the rows lie in each, and these together with all others within reach."""
    low, high = _bounds(points, rows)
    span, count = (high - low).clamp(min=reach), -(-len(rows) // PIECE)
    side = max(math.sqrt(float(span.prod()) / count), reach)
    down, across = ((span / side).long() + 1).tolist() if count > 1 else (1, 1)
    square = torch.empty(len(rows), dtype=torch.int32)
    for some in torch.arange(len(rows)).split(PIECE):
        i, j = ((points[rows[some], :2] - low) / side).long().unbind(dim=-1)
        square[some] = (i.clamp(0, down - 1) * across + j.clamp(0, across - 1)).int()
    order = square.argsort(stable=True)
    start = torch.searchsorted(square[order], torch.arange(down * across + 1, dtype=torch.int32)).tolist()
    del square
    for i in range(down):
        for j in range(across):
            own = order[start[i * across + j] : start[i * across + j + 1]]
            if not len(own):
                continue
            beside = torch.cat([
                own[:0],
                *(
                    order[start[k * across + m] : start[k * across + m + 1]]
                    for k in range(max(i - 1, 0), min(i + 2, down))
                    for m in range(max(j - 1, 0), min(j + 2, across))
                    if (k, m) != (i, j)
                ),
            ])  # fmt: skip
            low_here, high_here = _bounds(points, rows[own])
            place = points[rows[beside], :2]
            within = ((place >= low_here - reach) & (place <= high_here + reach)).all(dim=-1)
            yield own, torch.cat((own, beside[within]))


def _bounds(points: Float[Tensor, "all 3"], rows: Int[Tensor, " n"]) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Of some points, one at least, along x and y."""
    ends = [(some.amin(dim=0), some.amax(dim=0)) for some in (points[part, :2] for part in rows.split(PIECE))]
    low, high = (torch.stack(each) for each in zip(*ends, strict=True))
    return low.amin(dim=0), high.amax(dim=0)
