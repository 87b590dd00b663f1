"""Patches laid on surfaces by hand: what perfect, or wrong, photometry would have found."""

from dataclasses import replace

import torch
from torch import Tensor

from tests.dense.rendered_scenes import Rendered
from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.patches import Patches


def patches_at(
    cameras: RefractiveCamera,
    reference: int,
    pixels: Tensor,
    points: Tensor,
    normal: Tensor | tuple[float, float, float] = (0.0, 0.0, 1.0),
    sigma: float = 0.01,
    score: float = 0.9,
) -> Patches:
    """At points (k, 3) which the reference shows at pixels (k, 2), seen by no other image yet."""
    count, others = len(points), [i for i in range(len(cameras.center_in_world)) if i != reference]
    camera = cameras[reference]
    normals = torch.as_tensor(normal, dtype=torch.float64).expand(count, 3)
    return Patches(
        reference=torch.full((count,), reference),
        pixels=pixels,
        points=points,
        normals=torch.nn.functional.normalize(normals, dim=-1),
        sigma=torch.full((count,), sigma, dtype=torch.float64),
        footprint=(points - camera.center_in_world).norm(dim=-1) / camera.intrinsics.focal[0],
        score=torch.full((count,), score, dtype=torch.float64),
        others=torch.tensor(others).expand(count, -1),
        visible=torch.zeros(count, len(others), dtype=torch.bool),
    )


def patches_shown(rendered: Rendered, cell: int, images: tuple[int, ...] | None = None) -> Patches:
    """One for each cell of the images (all): exactly what the cell's middle pixel shows; `cell` is odd. Visible in
    those images that show the same point."""
    half = cell // 2
    height, width = rendered.images.shape[1:]
    rows, columns = torch.arange(height // cell) * cell + half, torch.arange(width // cell) * cell + half
    row, column = (place.flatten() for place in torch.meshgrid(rows, columns, indexing="ij"))
    pixels = torch.stack((column, row), dim=-1) + 0.5
    parts = []
    for image in range(len(rendered.images)) if images is None else images:
        points, normals = rendered.points[image, row, column], rendered.normals[image, row, column]
        patches = patches_at(rendered.cameras, image, pixels, points, normals)
        there = [_is_shown(rendered, other, patches) for other in patches.others[0].tolist()]
        parts.append(replace(patches, visible=torch.stack(there, dim=-1)))
    return Patches.together(parts)


def _is_shown(rendered: Rendered, image: int, patches: Patches) -> Tensor:
    """Whether an image shows each point, and not something else before it (k)."""
    pixels, valid = rendered.cameras[image].project(patches.points, inside_image=True)
    height, width = rendered.images.shape[1:]
    column, row = pixels[:, 0].long().clamp(0, width - 1), pixels[:, 1].long().clamp(0, height - 1)
    apart = (rendered.points[image, row, column] - patches.points).norm(dim=-1)
    return valid & (apart < 2.0 * patches.footprint)
