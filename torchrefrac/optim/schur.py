"""Normal equations of bundle adjustment, solved by eliminating the points (Schur complement).

Unknowns: m blocks of 6 ("cameras"), n blocks of 3 ("points"), g shared scalars. Every residual depends on one camera,
one point and the shared ones:

    [ B   E ] [dc]     [gc]          B: (6m + g)^2, dense;   V: n blocks 3x3
    [ E^T V ] [dp] = - [gp]

With V = L L^T per point and Z = L^-1 E^T (3n x (6m + g)) the reduced system is
(B - Z^T Z) dc = -gc + Z^T L^-1 gp, and dp = L^-T (-L^-1 gp - Z dc) puts the points back.

Cost: Z is formed in tiles of points that fit a fixed buffer, and Z^T Z is one matrix product a tile,
3n (6m + g)^2 multiplications in all: right for up to a few hundred cameras. Plan once, linearise per state, solve
per damping.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefrac.numerics import inverse_cholesky_3x3, segment_sum
from torchrefrac.optim.levenberg_marquardt import Step

CAMERA_SIZE = 6
POINT_SIZE = 3
TILE_ELEMENTS = 1 << 22


@dataclass(frozen=True)
class SchurPlan:
    """Which residual touches what: camera (N) and point (N) ids, point ids ascending, no pair twice.

    Built by `create`. `tiles` are (first point, end point, first residual, end residual).
    """

    camera: Tensor
    point: Tensor
    num_cameras: int
    num_points: int
    num_shared: int
    tiles: tuple[tuple[int, int, int, int], ...]

    @classmethod
    def create(
        cls, camera: Tensor, point: Tensor, num_cameras: int, num_points: int, num_shared: int = 0
    ) -> "SchurPlan":
        """Check the ids and cut the points into tiles. `num_points` 0: the points are constants."""
        size = CAMERA_SIZE * num_cameras + num_shared
        if num_points == 0:
            return cls(camera, point, num_cameras, 0, num_shared, ())
        if bool((point[1:] < point[:-1]).any()):
            raise ValueError("point must be sorted in ascending order")
        if len(torch.unique(point * num_cameras + camera)) < len(point):
            raise ValueError("a camera sees a point twice; each pair of camera and point may occur once")
        first = torch.searchsorted(point, torch.arange(num_points + 1, device=point.device)).tolist()
        per_tile = max(1, TILE_ELEMENTS // (POINT_SIZE * size))
        starts = range(0, num_points, per_tile)
        ends = [min(start + per_tile, num_points) for start in starts]
        tiles = tuple((a, b, first[a], first[b]) for a, b in zip(starts, ends, strict=True))
        return cls(camera, point, num_cameras, num_points, num_shared, tiles)

    @property
    def reduced_size(self) -> int:
        return CAMERA_SIZE * self.num_cameras + self.num_shared

    def linearize(
        self, residual: Tensor, by_camera: Tensor, by_point: Tensor, by_shared: Tensor, weight: Tensor
    ) -> "NormalEquations":
        """residual (N, r), its derivatives (N, r, 6), (N, r, 3), (N, r, g), weight (N) on the squared residual."""
        root = weight.sqrt()[:, None]
        residual = residual * root
        jc, jp, js = (j * root[..., None] for j in (by_camera, by_point, by_shared))
        m, g = self.num_cameras, self.num_shared
        size = self.reduced_size
        hessian = residual.new_zeros(size, size)
        blocks = segment_sum(jc.mT @ jc, self.camera, m)
        cameras = torch.arange(m, device=residual.device)
        grid = hessian[: CAMERA_SIZE * m, : CAMERA_SIZE * m].view(m, CAMERA_SIZE, m, CAMERA_SIZE)
        grid[cameras, :, cameras, :] = blocks
        gradient = residual.new_zeros(size)
        gradient[: CAMERA_SIZE * m] = segment_sum(_apply_t(jc, residual), self.camera, m).flatten()
        if g:
            mixed = segment_sum(jc.mT @ js, self.camera, m).reshape(-1, g)
            hessian[:-g, -g:] = mixed
            hessian[-g:, :-g] = mixed.T
            hessian[-g:, -g:] = torch.einsum("nri,nrj->ij", js, js)
            gradient[-g:] = torch.einsum("nri,nr->i", js, residual)
        n = self.num_points
        return NormalEquations(
            plan=self,
            hessian=hessian,
            gradient=gradient,
            point_hessian=segment_sum(jp.mT @ jp, self.point, n) if n else jp.new_zeros(0, 3, 3),
            point_gradient=segment_sum(_apply_t(jp, residual), self.point, n) if n else jp.new_zeros(0, 3),
            coupling=jp.mT @ jc if n else jp.new_zeros(0, 3, CAMERA_SIZE),
            shared_coupling=segment_sum(jp.mT @ js, self.point, n) if n else jp.new_zeros(0, 3, g),
        )


@dataclass(frozen=True)
class NormalEquations:
    """B and gc (dense), V and gp (per point), E as (N, 3, 6) per residual and (n, 3, g) for the shared unknowns.

    null_space (6m + g, k): orthonormal directions of the reduced unknowns in which the cost is flat (the gauge);
    undamped steps get no component along them, damped ones next to none (of the order of the damping).
    """

    plan: SchurPlan
    hessian: Tensor
    gradient: Tensor
    point_hessian: Tensor
    point_gradient: Tensor
    coupling: Tensor
    shared_coupling: Tensor
    null_space: Tensor | None = None

    def solve(self, damping: float) -> Step:
        """Step of the system damped by `damping` times its own diagonal. `solved` is False when it is singular."""
        diagonal = self.hessian.diagonal()
        point_diagonal = self.point_hessian.diagonal(dim1=-2, dim2=-1)
        factor = inverse_cholesky_3x3(self.point_hessian + torch.diag_embed(damping * point_diagonal))
        whitened = _apply(factor, self.point_gradient)
        reduced = self.hessian + torch.diag(damping * diagonal)
        rhs = -self.gradient
        for tile in self.plan.tiles:
            z = self._whitened_coupling(factor, tile)
            reduced = torch.addmm(reduced, z.T, z, alpha=-1.0)
            rhs = torch.addmv(rhs, z.T, whitened[tile[0] : tile[1]].flatten())
        if self.null_space is not None:
            scale = reduced.diagonal().mean()
            reduced = torch.addmm(reduced, self.null_space * scale, self.null_space.T)
        camera, solved = _solve_spd(reduced, rhs)
        point = self._back_substitute(factor, whitened, camera)
        gain = -(self.gradient @ camera) - (self.point_gradient * point).sum()
        bend = (diagonal * camera * camera).sum() + (point_diagonal * point * point).sum()
        return Step(camera, point, 0.5 * (gain + damping * bend), solved)

    def _whitened_coupling(self, factor: Tensor, tile: tuple[int, int, int, int]) -> Tensor:
        """Z of one tile: (3 * points, 6m + g)."""
        first, end, first_residual, end_residual = tile
        plan = self.plan
        camera = plan.camera[first_residual:end_residual]
        point = plan.point[first_residual:end_residual]
        size = CAMERA_SIZE * plan.num_cameras
        z = factor.new_zeros(end - first, POINT_SIZE, plan.reduced_size)
        blocks = z[..., :size].unflatten(-1, (plan.num_cameras, CAMERA_SIZE))
        blocks[point - first, :, camera, :] = factor[point] @ self.coupling[first_residual:end_residual]
        z[..., size:] = factor[first:end] @ self.shared_coupling[first:end]
        return z.flatten(0, 1)

    def _back_substitute(self, factor: Tensor, whitened: Tensor, camera: Tensor) -> Tensor:
        plan = self.plan
        if plan.num_points == 0:
            return whitened
        size = CAMERA_SIZE * plan.num_cameras
        blocks = camera[:size].reshape(-1, CAMERA_SIZE)
        moved = segment_sum(_apply(self.coupling, blocks[plan.camera]), plan.point, plan.num_points)
        moved = moved + self.shared_coupling @ camera[size:]
        return -_apply_t(factor, whitened + _apply(factor, moved))


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


def _apply_t(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix.mT @ vector[..., None])[..., 0]


def _solve_spd(matrix: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky with unit diagonal scaling; the mask is False (and the solution zero) where it breaks down."""
    scale = matrix.diagonal().clamp(min=torch.finfo(matrix.dtype).tiny).rsqrt()
    factor, info = torch.linalg.cholesky_ex(matrix * scale[:, None] * scale)
    solved = info == 0
    solution = torch.cholesky_solve((rhs * scale)[:, None], factor)[:, 0] * scale
    solved = solved & solution.isfinite().all()
    return torch.where(solved, solution, torch.zeros_like(solution)), solved
