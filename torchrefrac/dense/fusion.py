"""The patches of views that were each filled on their own, as one surface."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.patches import Patches

REACH = 3.0  # cells within which the other patch must lie


def fuse(patches: Patches, cameras: RefractiveCamera, cell: int, min_maps: int) -> Patches:
    """Patches that at least `min_maps` views found, each once, at the mean of what these views found.

    cameras (m): of all views. A patch is found again by a view whose own patch in that place lies in the same plane.
    The mean is taken along the normal, weighted by 1 / sigma^2; sigma stays that of the better patch, as they share
    photographs.
    """
    tables = _tables(patches, cameras, cell)
    taken = torch.zeros(len(patches), dtype=torch.bool)
    chosen, points, sigma = [], [], []
    for image in range(cameras.shape[0]):
        rows = ((patches.reference == image) & ~taken).nonzero()[:, 0]
        weight = patches.sigma[rows].square().reciprocal()
        total, moved = weight.clone(), torch.zeros_like(weight)
        best, maps = patches.sigma[rows], torch.ones_like(rows)
        found = []
        for other in range(cameras.shape[0]):
            if other == image:
                continue
            match, offset, agrees = _found_again(patches, rows, cameras[other], tables[other], cell)
            share = torch.where(agrees, patches.sigma[match].square().reciprocal(), 0.0)
            total += share
            moved += share * offset
            best = torch.where(agrees, torch.minimum(best, patches.sigma[match]), best)
            maps += agrees
            found.append((match, agrees))
        good = maps >= min_maps
        for match, agrees in found:
            taken[match[agrees & good]] = True
        chosen.append(rows[good])
        points.append(patches.points[rows[good]] + (moved / total)[good, None] * patches.normals[rows[good]])
        sigma.append(best[good])
    return replace(patches[torch.cat(chosen)], points=torch.cat(points), sigma=torch.cat(sigma))


def _tables(patches: Patches, cameras: RefractiveCamera, cell: int) -> list[Int[Tensor, "rows columns"]]:
    """For every view, the patch of each of its cells, -1 where there is none."""
    width, height = cameras.intrinsics.width, cameras.intrinsics.height
    tables = []
    for image in range(cameras.shape[0]):
        rows = (patches.reference == image).nonzero()[:, 0]
        table = torch.full((height // cell + 1, width // cell + 1), -1, dtype=torch.long)
        column, row = (patches.pixels[rows] / cell).long().unbind(dim=-1)
        table[row, column] = rows
        tables.append(table)
    return tables


def _found_again(
    patches: Patches, rows: Int[Tensor, " k"], camera: RefractiveCamera, table: Int[Tensor, "rows columns"], cell: int
) -> tuple[Int[Tensor, " k"], Float[Tensor, " k"], Bool[Tensor, " k"]]:
    """The other view's patch where each of `rows` is seen, how far its plane is along the normal, and whether the two
    are the same surface."""
    pixels, valid = camera.project(patches.points[rows], inside_image=True)
    column, row = (pixels / cell).long().unbind(dim=-1)
    match = table[row.clamp(0, table.shape[0] - 1), column.clamp(0, table.shape[1] - 1)]
    valid = valid & (match >= 0)
    match = match.clamp(min=0)
    apart = patches.points[match] - patches.points[rows]
    turned = (patches.normals[match] * patches.normals[rows]).sum(dim=-1)
    valid = valid & (turned > 0.5)
    offset = (apart * patches.normals[match]).sum(dim=-1) / torch.where(valid, turned, 1.0)
    near = apart.norm(dim=-1) < REACH * cell * torch.maximum(patches.footprint[rows], patches.footprint[match])
    thickness = torch.maximum(patches.thickness[rows], patches.thickness[match])
    return match, offset, valid & near & (offset.abs() < thickness)
