"""Distances from points to the nearest of many triangles, by a tree of the centroids of pieces of them."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

if TYPE_CHECKING:
    from scipy.spatial import KDTree

PIECES, MOST_PIECES = 20_000, 2_000_000  # into how many a small mesh is cut, and any mesh at most
FIRST, GROWTH, MOST = 12, 4, 192  # pieces that are looked at for a point: at first, times as many next, at most
ROUNDING = 1e-9  # of a bound, which must not rule out what it just allows
PAIRS = 1 << 18  # of a point and a piece, at a time


@dataclass(frozen=True, eq=False)
class MeshDistance:
    """Triangles `corners`, and pieces of them: `owner` is the triangle of each, `normal` its unit normal; `tree` holds
    their centroids, and no place of a piece is farther than its `radius` from its centroid."""

    corners: Float[np.ndarray, "f 3 3"]
    owner: Int[np.ndarray, " p"]
    normal: Float[np.ndarray, "p 3"]
    radius: Float[np.ndarray, " p"]
    tree: "KDTree"

    @classmethod
    def of(cls, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> "MeshDistance":
        """Cut the triangles into pieces of a similar size, so that near a point lie
        the centroids of what is near it. Triangles without an area do not count. Raises ValueError where none has one.
        """
        from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

        corners = vertices.numpy()[faces.numpy()]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normal, axis=-1)
        corners, normal, area = corners[area > 0.0], normal[area > 0.0], area[area > 0.0]
        if not len(corners):
            raise ValueError("faces has no triangle with an area, but a distance needs at least one")
        pieces, owner = _cut(corners, float(np.sqrt(3.0 * area.sum() / max(PIECES, len(corners)))))
        centroid = pieces.mean(axis=1)
        radius = np.linalg.norm(pieces - centroid[:, None], axis=-1).max(axis=-1)
        tree = KDTree(centroid, balanced_tree=False, compact_nodes=False)
        return cls(corners, owner, (normal / area[:, None])[owner], radius, tree)

    @cached_property
    def reach(self) -> float:
        """The largest radius."""
        return float(self.radius.max())

    def distance(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Distance of points to the nearest triangle.

        More and more pieces are looked at, until no other one can be nearer: exact for points nearer to the surface
        than some ten times `reach`. For those farther away the search ends before that is certain. It may then miss
        the nearest piece where that faces away from the point, by less than twice `reach`.
        """
        queries = points.detach().cpu().double().numpy()
        best, left, seen = np.full(len(queries), np.inf), np.arange(len(queries)), 0
        while len(left) and seen < min(MOST, len(self.owner)):
            upto = min(max(FIRST, GROWTH * seen), MOST, len(self.owner))
            ranks = np.arange(seen + 1, upto + 1)
            blocks = np.array_split(left, -(-len(left) * len(ranks) // PAIRS))
            open_ = [block[self._look(queries, best, block, ranks)] for block in blocks]
            left, seen = np.concatenate(open_), upto
        return torch.from_numpy(best)

    def _look(
        self,
        queries: Float[np.ndarray, "n 3"],
        best: Float[np.ndarray, " n"],
        rows: Int[np.ndarray, " q"],
        ranks: Int[np.ndarray, " k"],
    ) -> Bool[np.ndarray, " q"]:
        """Lower `best` at `rows` by the pieces of these ranks; for which rows others could still be nearer."""
        from trimesh.triangles import closest_point  # noqa: PLC0415 - slow to import

        gap, piece = self.tree.query(queries[rows], k=ranks)
        row, column = np.nonzero(gap <= np.minimum(best[rows], gap[:, 0])[:, None] + self.reach)
        near, piece = queries[rows[row]], piece[row, column]
        at_most = np.minimum(best[rows], gap[:, 0])[row]  # a centroid lies on the surface
        chosen = self._distance_to_discs(near, gap[row, column], piece) <= at_most * (1.0 + ROUNDING)
        near = near[chosen]
        found = closest_point(self.corners[self.owner[piece[chosen]]], near)
        np.minimum.at(best, rows[row[chosen]], np.linalg.norm(found - near, axis=-1))
        return gap[:, -1] - self.reach < best[rows]

    def _distance_to_discs(
        self, points: Float[np.ndarray, "q 3"], gap: Float[np.ndarray, " q"], piece: Int[np.ndarray, " q"]
    ) -> Float[np.ndarray, " q"]:
        """From points, `gap` away from the centroids of pieces, to the discs that the pieces lie in."""
        height = ((points - self.tree.data[piece]) * self.normal[piece]).sum(axis=-1)
        aside = np.sqrt(np.maximum(gap * gap - height * height, 0.0)) - self.radius[piece]
        return np.hypot(height, np.maximum(aside, 0.0))


def _cut(
    corners: Float[np.ndarray, "f 3 3"], longest: float
) -> tuple[Float[np.ndarray, "p 3 3"], Int[np.ndarray, " p"]]:
    """Pieces of triangles, and which triangle each is of: the longest edge is halved until none is
    longer than `longest`, or the pieces would be too many."""
    pieces, owner, done = corners, np.arange(len(corners)), []
    count = len(corners)
    while len(pieces):
        edges = np.linalg.norm(pieces[:, [1, 2, 0]] - pieces, axis=-1)
        long = edges.max(axis=1) > longest
        count += int(long.sum())
        if count > MOST_PIECES:
            break
        done.append((pieces[~long], owner[~long]))
        turned = (edges[long].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(pieces[long], turned[..., None], axis=1).transpose(1, 0, 2)
        middle = 0.5 * (a + b)
        pieces = np.concatenate((np.stack((a, middle, c), axis=1), np.stack((middle, b, c), axis=1)))
        owner = np.concatenate((owner[long], owner[long]))
    done.append((pieces, owner))
    return np.concatenate([part for part, _ in done]), np.concatenate([part for _, part in done])
