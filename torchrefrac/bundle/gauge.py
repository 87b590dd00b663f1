"""The directions in which cameras can move with the scene and the water without anything noticing."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.state import BundleState
from torchrefrac.bundle.terms import Residuals
from torchrefrac.geometry import Plane

UNNOTICED = 1e-9
SCALE = 6


def similarity_motions(state: BundleState, layout: Layout) -> tuple[Tensor, Tensor]:
    """How the seven infinitesimal similarities move the reduced unknowns (size, 7), and what is held (k, 7).

    Shifts along x, y, z; turns about x, y, z through the origin; scale about it.
    """
    rotation, center, (normal, offset) = state.rotation, state.center, state.planes
    axes = torch.eye(3, dtype=center.dtype, device=center.device)
    m, e = len(center), len(normal)
    poses, planes, points = center.new_zeros(m, 6, 7), center.new_zeros(e, 3, 7), center.new_zeros(0, 3, 7)
    kept = state.points[layout.kept] if layout.kept is not None else state.points[:0]
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
        motions[layout.point_columns(layout.kept.nonzero()[:, 0]).flatten()] = points.flatten(0, 1)
    held = [] if layout.held is None else [poses[layout.held]]
    if float(state.index_ratio) > 1.0 or "index_ratio" in layout.water:
        held.append(planes.flatten(0, 1)[plane_columns == layout.size])
    motions[-1] = 0.0
    return motions[:-1], torch.cat((*held, center.new_zeros(0, 7)))


def gauge_directions(state: BundleState, layout: Layout, residuals: Sequence[Residuals] = ()) -> Tensor | None:
    """Orthonormal basis (size, k) of the gauge; None where there is none.

    Through a water plane that is held k = 4: shifts along it, heading, and scale about it. Without refraction k = 7.
    What is held and what is measured (`residuals`) take away those motions that they notice.
    """
    motions, held = similarity_motions(state, layout)
    padded = torch.nn.functional.pad(motions, (0, 0, 0, 1))
    noticed = [held]
    for _, jacobian, columns in residuals:
        size = jacobian.norm(dim=-1, keepdim=True)
        noticed.append((jacobian / torch.where(size > 0, size, 1.0) @ padded[columns]).reshape(-1, 7))
    notices = torch.cat(noticed)
    scale = torch.cat((motions, notices)).norm(dim=0).clamp(min=torch.finfo(motions.dtype).tiny)
    _, triangle = torch.linalg.qr(torch.cat((motions / scale, held / scale)))
    basis = torch.linalg.pinv(triangle)
    seen = notices / scale @ basis
    if len(seen):
        _, singular, directions = torch.linalg.svd(seen, full_matrices=True)
        unseen = torch.ones(7, dtype=torch.bool, device=singular.device)
        unseen[: len(singular)] = singular <= UNNOTICED
        basis = basis @ directions.T[:, unseen]
    if basis.shape[1] == 0:
        return None
    moves = (motions != 0.0).any(dim=1, keepdim=True)
    return torch.where(moves, torch.linalg.qr(motions / scale @ basis).Q, 0.0)  # what is held gets no rounding error


def _turned(axis: Tensor, vectors: Tensor) -> Tensor:
    return torch.linalg.cross(axis.expand_as(vectors), vectors)
