"""The directions in which views can move with the points and the water without any residual changing."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.terms import Residuals
from torchrefrac.geometry import skew
from torchrefrac.scene import Scene

UNNOTICED = 1e-9
ROUNDS = 3
SCALE = 6


def similarity_motions(scene: Scene, layout: Layout) -> tuple[Float[Tensor, "size 7"], Float[Tensor, "fixed 7"]]:
    """How the seven infinitesimal similarities move the reduced unknowns, and what is fixed. Shifts along x, y, z;
    turns about x, y, z through the origin; scale about it."""
    rotation, center, interfaces = scene.views.rotation, scene.views.center, scene.interfaces
    normal, offset = interfaces.normal, interfaces.offset
    m, e = len(center), len(normal)
    poses, planes = center.new_zeros(m, 6, 7), center.new_zeros(e, 3, 7)
    position = scene.points[layout.reduced_points]
    points = center.new_zeros(len(position), 3, 7)
    first, second = interfaces.planes.tangents_like(center)
    axes, turned = torch.eye(3, dtype=center.dtype, device=center.device), -skew(normal)
    poses[:, 3:, :3], points[..., :3], planes[:, 2, :3] = axes, axes, normal
    poses[:, :3, 3:SCALE], poses[:, 3:, 3:SCALE], points[..., 3:SCALE] = -rotation, -skew(center), -skew(position)
    if interfaces.move_with_camera:
        planes[:, 2, :3], turned = 0.0, torch.zeros_like(turned)
    planes[:, 0, 3:SCALE] = -(second[:, None] @ turned)[:, 0]
    planes[:, 1, 3:SCALE] = (first[:, None] @ turned)[:, 0]
    poses[:, 3:, SCALE], points[..., SCALE], planes[:, 2, SCALE] = center, position, offset
    motions = center.new_zeros(layout.size + 1, 7)
    motions[layout.pose_columns(torch.arange(m, device=center.device)).flatten()] = poses.flatten(0, 1)
    plane_columns = layout.plane_columns(layout.interfaces).flatten()
    motions[plane_columns] = planes.flatten(0, 1)
    thickness, thick = interfaces.thickness, layout.medium_column("layer_thickness")
    if thick < layout.size:
        motions[thick, SCALE] = thickness.max()
    if layout.reduced is not None:
        motions[layout.point_columns(layout.reduced_points).flatten()] = points.flatten(0, 1)
    fixed = [] if layout.fixed is None else [torch.where(layout.fixed[..., None], poses, 0.0).flatten(0, 1)]
    if layout.refractive or "index_ratio" in layout.water:
        fixed.append(torch.where((plane_columns == layout.size)[:, None], planes.flatten(0, 1), 0.0))
        if thick == layout.size and interfaces.has_layers:
            fixed.append(torch.nn.functional.pad(thickness.reshape(-1, 1), (SCALE, 0)))
    motions[-1] = 0.0
    return motions[:-1], torch.cat((*fixed, center.new_zeros(0, 7)))


def gauge_directions(
    scene: Scene, layout: Layout, residuals: Sequence[Residuals] = (), count: int | None = None
) -> Float[Tensor, "size k"] | None:
    """Orthonormal basis of the gauge; None where there is none.

    Through an interface that is fixed k = 4: shifts along it, heading, and scale about it. Without refraction k = 7.
    What is fixed and what is measured (`residuals`) take away those motions that change them. count: k, where it is
    known from before; nothing then waits for a GPU.
    """
    motions, notices = _scaled(scene, layout, residuals)
    if count is None:
        count = _count(motions, notices)
    if count == 0:
        return None
    every = _triangle(torch.cat((motions, notices)))
    seen = torch.linalg.solve_triangular(every, notices, upper=True, left=False)
    combined = torch.linalg.solve_triangular(every, _unnoticed(seen, count), upper=True)
    basis = torch.linalg.qr(motions @ combined).Q
    return torch.where((motions != 0.0).any(dim=1, keepdim=True), basis, 0.0)  # what is fixed gets no rounding error


def count_gauge(scene: Scene, layout: Layout, residuals: Sequence[Residuals] = ()) -> int:
    """How many directions `gauge_directions` has."""
    return _count(*_scaled(scene, layout, residuals))


def _scaled(
    scene: Scene, layout: Layout, residuals: Sequence[Residuals]
) -> tuple[Float[Tensor, "size 7"], Float[Tensor, "k 7"]]:
    """The motions, and how they change what is fixed and what is measured, each of about unit length."""
    motions, fixed = similarity_motions(scene, layout)
    padded = torch.nn.functional.pad(motions, (0, 0, 0, 1))
    noticed = [fixed]
    for _, jacobian, columns in residuals:
        size = jacobian.norm(dim=-1, keepdim=True)
        noticed.append((jacobian / torch.where(size > 0, size, 1.0) @ padded[columns]).reshape(-1, 7))
    notices = torch.cat(noticed)
    scale = torch.cat((motions, notices)).norm(dim=0).clamp(min=torch.finfo(motions.dtype).tiny)
    return motions / scale, notices / scale


def _count(motions: Float[Tensor, "size 7"], notices: Float[Tensor, "k 7"]) -> int:
    """How many combinations of the motions move something, and nothing that is noticed."""
    every = torch.cat((motions, notices))
    _, triangle = torch.linalg.qr(torch.nn.functional.pad(every, (0, 0, 0, max(0, 7 - len(every)))))
    seen = notices @ torch.linalg.pinv(triangle, rtol=UNNOTICED)
    moving = int(torch.linalg.matrix_rank(triangle, rtol=UNNOTICED))
    return moving - int((torch.linalg.svdvals(seen) > UNNOTICED).sum()) if len(seen) else moving


def _unnoticed(notices: Float[Tensor, "k 7"], count: int) -> Float[Tensor, "7 {count}"]:
    """An orthonormal basis of the combinations that are not noticed, by inverse iteration."""
    triangle = _triangle(notices)
    row, column = (torch.arange(n, device=triangle.device) for n in (7, count))
    basis = torch.cos((row[:, None] + 0.5) * (column + 1.0)).to(triangle)
    for _ in range(ROUNDS):
        basis = torch.linalg.qr(torch.linalg.solve_triangular(triangle.T, basis, upper=False)).Q
        basis = torch.linalg.qr(torch.linalg.solve_triangular(triangle, basis, upper=True)).Q
    return basis


def _triangle(rows: Float[Tensor, "k 7"]) -> Float[Tensor, "7 7"]:
    """R of the QR decomposition, with pivots that are not zero."""
    _, triangle = torch.linalg.qr(torch.nn.functional.pad(rows, (0, 0, 0, max(0, 7 - len(rows)))))
    pivot, eps = triangle.diagonal(), torch.finfo(triangle.dtype).eps
    return triangle + torch.where(pivot.abs() > eps, 0.0, eps).diag_embed()
