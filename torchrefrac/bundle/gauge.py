"""The directions in which cameras can move with the scene and the water without anything noticing."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.state import BundleState
from torchrefrac.bundle.terms import Residuals
from torchrefrac.geometry import Plane

UNNOTICED = 1e-9
ROUNDS = 3
SCALE = 6


def similarity_motions(state: BundleState, layout: Layout) -> tuple[Tensor, Tensor]:
    """How the seven infinitesimal similarities move the reduced unknowns (size, 7), and what is held (k, 7).

    Shifts along x, y, z; turns about x, y, z through the origin; scale about it.
    """
    rotation, center, (normal, offset) = state.rotation, state.center, state.planes
    axes = torch.eye(3, dtype=center.dtype, device=center.device)
    m, e = len(center), len(normal)
    poses, planes = center.new_zeros(m, 6, 7), center.new_zeros(e, 3, 7)
    kept = state.points[layout.kept_points]
    points = center.new_zeros(len(kept), 3, 7)
    first, second = Plane(normal, offset, check=False).tangents_like(center)
    for k, axis in enumerate(axes):
        poses[:, 3:, k], points[..., k], planes[:, 2, k] = axis, axis, normal @ axis
        poses[:, :3, 3 + k] = -(rotation @ axis)
        poses[:, 3:, 3 + k], points[..., 3 + k] = _turned(axis, center), _turned(axis, kept)
        turned = _turned(axis, normal)
        planes[:, 0, 3 + k], planes[:, 1, 3 + k] = -(second * turned).sum(-1), (first * turned).sum(-1)
    poses[:, 3:, SCALE], points[..., SCALE], planes[:, 2, SCALE] = center, kept, offset
    motions = center.new_zeros(layout.size + 1, 7)
    images = torch.arange(m, device=center.device)
    motions[layout.pose_columns(images).flatten()] = poses.flatten(0, 1)
    plane_columns = layout.plane_columns(torch.arange(e, device=center.device)).flatten()
    motions[plane_columns] = planes.flatten(0, 1)
    if layout.kept is not None:
        motions[layout.point_columns(layout.kept_points).flatten()] = points.flatten(0, 1)
    held = [] if layout.held is None else [torch.where(layout.held[..., None], poses, 0.0).flatten(0, 1)]
    if layout.refractive or "index_ratio" in layout.water:
        held.append(torch.where((plane_columns == layout.size)[:, None], planes.flatten(0, 1), 0.0))
    motions[-1] = 0.0
    return motions[:-1], torch.cat((*held, center.new_zeros(0, 7)))


def gauge_directions(
    state: BundleState, layout: Layout, residuals: Sequence[Residuals] = (), count: int | None = None
) -> Tensor | None:
    """Orthonormal basis (size, k) of the gauge; None where there is none.

    Through a water plane that is held k = 4: shifts along it, heading, and scale about it. Without refraction k = 7.
    What is held and what is measured (`residuals`) take away those motions that they notice. count: k, where it is
    known from before; nothing then waits for a GPU.
    """
    motions, notices = _scaled(state, layout, residuals)
    if count is None:
        count = _count(motions, notices)
    if count == 0:
        return None
    every = _triangle(torch.cat((motions, notices)))
    seen = torch.linalg.solve_triangular(every, notices, upper=True, left=False)
    combined = torch.linalg.solve_triangular(every, _unnoticed(seen, count), upper=True)
    basis = torch.linalg.qr(motions @ combined).Q
    return torch.where((motions != 0.0).any(dim=1, keepdim=True), basis, 0.0)  # what is held gets no rounding error


def count_gauge(state: BundleState, layout: Layout, residuals: Sequence[Residuals] = ()) -> int:
    """How many directions `gauge_directions` has."""
    return _count(*_scaled(state, layout, residuals))


def _scaled(state: BundleState, layout: Layout, residuals: Sequence[Residuals]) -> tuple[Tensor, Tensor]:
    """The motions (size, 7), and how they move what is held and what is measured (k, 7), each of about unit length."""
    motions, held = similarity_motions(state, layout)
    padded = torch.nn.functional.pad(motions, (0, 0, 0, 1))
    noticed = [held]
    for _, jacobian, columns in residuals:
        size = jacobian.norm(dim=-1, keepdim=True)
        noticed.append((jacobian / torch.where(size > 0, size, 1.0) @ padded[columns]).reshape(-1, 7))
    notices = torch.cat(noticed)
    scale = torch.cat((motions, notices)).norm(dim=0).clamp(min=torch.finfo(motions.dtype).tiny)
    return motions / scale, notices / scale


def _count(motions: Tensor, notices: Tensor) -> int:
    """How many combinations of the motions move something, and nothing that is noticed."""
    every = torch.cat((motions, notices))
    _, triangle = torch.linalg.qr(torch.nn.functional.pad(every, (0, 0, 0, max(0, 7 - len(every)))))
    seen = notices @ torch.linalg.pinv(triangle, rtol=UNNOTICED)
    moving = int(torch.linalg.matrix_rank(triangle, rtol=UNNOTICED))
    return moving - int((torch.linalg.svdvals(seen) > UNNOTICED).sum()) if len(seen) else moving


def _unnoticed(notices: Tensor, count: int) -> Tensor:
    """An orthonormal basis (7, count) of the combinations that are not noticed, by inverse iteration."""
    triangle = _triangle(notices)
    row, column = torch.meshgrid(torch.arange(7), torch.arange(count), indexing="ij")
    basis = torch.cos((row + 0.5) * (column + 1.0)).to(triangle)
    for _ in range(ROUNDS):
        basis = torch.linalg.qr(torch.linalg.solve_triangular(triangle.T, basis, upper=False)).Q
        basis = torch.linalg.qr(torch.linalg.solve_triangular(triangle, basis, upper=True)).Q
    return basis


def _triangle(rows: Tensor) -> Tensor:
    """R (7, 7) of the QR decomposition of rows (k, 7), its pivots kept from zero."""
    _, triangle = torch.linalg.qr(torch.nn.functional.pad(rows, (0, 0, 0, max(0, 7 - len(rows)))))
    pivot, eps = triangle.diagonal(), torch.finfo(triangle.dtype).eps
    return triangle + torch.where(pivot.abs() > eps, 0.0, eps).diag_embed()


def _turned(axis: Tensor, vectors: Tensor) -> Tensor:
    return torch.linalg.cross(axis.expand_as(vectors), vectors)
