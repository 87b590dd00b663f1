"""The points eliminated at one damping.

With X_i V_i X_i^T = I for every (damped) point and Z = X E^T, the reduced system is

    (B - Z^T Z) dc = -gc + Z^T X gp,        dp = -X^T (X gp + Z dc).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.numerics import inverse_cholesky_components
from torchrefrac.optim.normal_equations import UPPER, NormalEquations, in_cache
from torchrefrac.optim.plan import CAMERA_SIZE, POINT_SIZE, TILE, Chunk, Family

BLOCK = CAMERA_SIZE * CAMERA_SIZE


class Tiles(NamedTuple):
    """Z of B tiles: by_camera (B, 3 TILE, 6 C) in the unknowns of the C cameras that see them, by_shared (B, 3 TILE, g)
    in those of all families."""

    chunk: Chunk
    by_camera: Tensor
    by_shared: Tensor


@dataclass(frozen=True)
class Elimination:
    """`system` with every point's Hessian raised by `damping` times its diagonal."""

    system: NormalEquations
    damping: float

    @cached_property
    def factor(self) -> Tensor:
        """X (6, places): lower triangles."""
        lift = [1.0 + self.damping if i == j else 1.0 for i, j in UPPER]
        return torch.stack(
            inverse_cholesky_components([h * by for h, by in zip(self.system.point_hessian, lift, strict=True)])
        )

    @cached_property
    def whitened(self) -> Tensor:
        """X gp (3, places)."""
        return _lower_times(self.factor, self.system.point_gradient)

    def tiles(self) -> Iterator[Tiles]:
        """Chunk by chunk. One buffer serves all: use one before asking for the next."""
        plan = self.system.plan
        largest = max((len(c.cameras) * TILE * c.cameras.shape[1] for c in plan.chunks), default=0)
        buffer = self.factor.new_empty(largest * POINT_SIZE, CAMERA_SIZE)
        for chunk in plan.chunks:
            rows = self.system.rows[..., chunk.observations]
            slim = self._whitened_rows(chunk, rows)
            z = _outer(slim, rows[:, :CAMERA_SIZE]).flatten(0, 1).T.reshape(-1, CAMERA_SIZE)
            across = chunk.cameras.shape[1]
            here = buffer[: len(chunk.cameras) * TILE * POINT_SIZE * across].zero_()
            step = across * torch.arange(POINT_SIZE, device=z.device)
            here.index_copy_(0, (chunk.place[:, None] + step).flatten(), z)
            yield Tiles(
                chunk, here.view(-1, POINT_SIZE * TILE, across * CAMERA_SIZE), self._shared_part(chunk, slim, rows)
            )

    def reduced(self) -> tuple[Tensor, Tensor]:
        """The reduced system, undamped in what is kept: a matrix (size, size), its lower triangle, and -rhs (size)."""
        m, g = self.system.plan.num_cameras, self.system.plan.num_shared
        by_pair = self.factor.new_zeros((m + 1) * (m + 1), BLOCK)
        mixed = self.factor.new_zeros(m + 1, CAMERA_SIZE * (g + 1))
        shared = self.factor.new_zeros(g + 1, g + 1)
        for chunk, z, z_shared in self.tiles():
            whitened = self.whitened[:, chunk.tiles.start * TILE : chunk.tiles.stop * TILE].T.reshape(len(z), -1, 1)
            rest = torch.cat((z_shared, whitened), dim=-1)
            _add_products(by_pair, z, chunk.cameras)
            across = (z.mT @ rest).reshape(-1, mixed.shape[1])
            mixed.index_add_(0, chunk.cameras.flatten(), across)
            flat = rest.flatten(0, 1)
            shared.addmm_(flat.T, flat)
        matrix, rhs = self.system.dense(), self.system.gradient.clone()
        first, end = CAMERA_SIZE * m, CAMERA_SIZE * m + g
        square = matrix[:first, :first].view(m, CAMERA_SIZE, m, CAMERA_SIZE)
        square -= by_pair.view(m + 1, m + 1, CAMERA_SIZE, CAMERA_SIZE)[:m, :m].transpose(1, 2)
        across = mixed[:m].reshape(first, g + 1)
        matrix[first:end, :first] -= across[:, :g].T
        matrix[first:end, first:end] -= shared[:g, :g]
        rhs[:first] -= across[:, g]
        rhs[first:end] -= shared[:g, g]
        return matrix, rhs

    def along_points(self, x: Tensor) -> Tensor:
        """E^T x (3, places), for reduced unknowns x (size)."""
        plan, rows = self.system.plan, self.system.rows
        local = x[plan.columns].T.contiguous()
        total = self.factor.new_zeros(POINT_SIZE, plan.num_places)
        for here in in_cache(rows.shape[-1]):
            at = local.index_select(1, plan.camera[here])
            moved = (rows[:, :-4, here] * at).sum(dim=1, keepdim=True)
            total.index_add_(1, plan.point[here], (rows[:, -4:-1, here] * moved).sum(dim=0))
        return total

    def along_cameras(self, y: Tensor) -> Tensor:
        """E y (size), for y (3, places)."""
        plan, rows = self.system.plan, self.system.rows
        local = self.factor.new_zeros(plan.columns.shape[1], plan.num_cameras)
        for here in in_cache(rows.shape[-1]):
            at = y.index_select(1, plan.point[here])
            moved = (rows[:, -4:-1, here] * at).sum(dim=1, keepdim=True)
            local.index_add_(1, plan.camera[here], (rows[:, :-4, here] * moved).sum(dim=0))
        return y.new_zeros(plan.size).index_add_(0, plan.columns.T.flatten(), local.flatten())

    def back_substitute(self, x: Tensor) -> Tensor:
        """The points' step (3, places) for the step x (size) of what is kept."""
        if self.system.rows.shape[-1] == 0:
            return self.whitened
        pulled = self.whitened + _lower_times(self.factor, self.along_points(x))
        return -_upper_times(self.factor, pulled)

    def times_inverse(self, y: Tensor) -> Tensor:
        """V^-1 y for y (3, places)."""
        return _upper_times(self.factor, _lower_times(self.factor, y))

    def _whitened_rows(self, chunk: Chunk, rows: Tensor) -> Tensor:
        """J_p X^T (3, r, k)."""
        x00, x10, x11, x20, x21, x22 = self.factor.index_select(1, self.system.plan.point[chunk.observations])
        p0, p1, p2 = rows[:, -4:-1].unbind(dim=1)
        return torch.stack((p0 * x00, p0 * x10 + p1 * x11, p0 * x20 + p1 * x21 + p2 * x22))

    def _shared_part(self, chunk: Chunk, slim: Tensor, rows: Tensor) -> Tensor:
        plan = self.system.plan
        tiles, places = len(chunk.cameras), len(chunk.cameras) * TILE
        point = plan.point[chunk.observations] - chunk.tiles.start * TILE
        parts, first = [], CAMERA_SIZE
        for family in plan.families:
            by = _outer(slim, rows[:, first : first + family.size])
            parts.append(_summed(by, point, plan.camera[chunk.observations], family, places))
            first += family.size
        if not parts:
            return slim.new_zeros(tiles, POINT_SIZE * TILE, 0)
        return torch.cat(parts, dim=-1).reshape(tiles, POINT_SIZE * TILE, -1)


def _summed(by: Tensor, point: Tensor, camera: Tensor, family: Family, places: int) -> Tensor:
    """(3, s, k) summed over the observations of each point that share a member: (places, 3, count * s)."""
    member = point if family.count == 1 else point * family.count + family.of_camera[camera]
    total = by.new_zeros(POINT_SIZE * family.size, places * family.count).index_add_(1, member, by.flatten(0, 1))
    return total.view(POINT_SIZE, family.size, places, family.count).permute(2, 0, 3, 1).flatten(2)


def _outer(slim: Tensor, rows: Tensor) -> Tensor:
    """Sum over r of slim (3, r, k) times rows (r, s, k): (3, s, k)."""
    total = slim[:, 0, None] * rows[None, 0]
    for r in range(1, len(rows)):
        total.addcmul_(slim[:, r, None], rows[None, r])
    return total


def _add_products(by_pair: Tensor, z: Tensor, cameras: Tensor) -> None:
    """Add the 6x6 blocks of Z^T Z to those of pairs of cameras: none is left out in the lower triangle.

    Cameras ascend along C, so that a strip of rows needs only the columns up to its own.
    """
    m, across = int(by_pair.shape[0] ** 0.5), cameras.shape[1]
    bounds = sorted({0, across // 2, across})
    for first, end in pairwise(bounds):
        strip = z[..., first * CAMERA_SIZE : end * CAMERA_SIZE].mT @ z[..., : end * CAMERA_SIZE]
        blocks = strip.view(-1, end - first, CAMERA_SIZE, end, CAMERA_SIZE).transpose(2, 3).reshape(-1, BLOCK)
        pair = cameras[:, first:end, None] * m + cameras[:, None, :end]
        by_pair.index_add_(0, pair.flatten(), blocks)


def _lower_times(x: Tensor, y: Tensor) -> Tensor:
    """X y for lower triangles X (6, n) and y (3, n)."""
    return torch.stack((x[0] * y[0], x[1] * y[0] + x[2] * y[1], x[3] * y[0] + x[4] * y[1] + x[5] * y[2]))


def _upper_times(x: Tensor, y: Tensor) -> Tensor:
    """X^T y."""
    return torch.stack((x[0] * y[0] + x[1] * y[1] + x[3] * y[2], x[2] * y[1] + x[4] * y[2], x[5] * y[2]))
