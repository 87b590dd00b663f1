"""Which patches contradict others: they hide what is seen through them, or stand alone (PMVS's filters)."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.rays import depth_in

NEAREST = 12  # patches around one that it is judged by
REACH = 4.0  # cells within which these must lie
THICKNESS = 4.0  # footprints within which two patches in one line of sight are the same surface


def supported(patches: Patches, cell: int) -> Bool[Tensor, " n"]:
    """Which patches lie on the planes of most of their neighbours, and these on theirs."""
    count = len(patches)
    if count <= NEAREST:
        return torch.ones_like(patches.score, dtype=torch.bool)
    points = patches.points.numpy()
    distance, index = (np.asarray(found) for found in KDTree(points).query(points, k=NEAREST + 1, workers=1))
    near = torch.from_numpy(distance[:, 1:]) < REACH * cell * patches.footprint[:, None]
    index = torch.from_numpy(np.ascontiguousarray(index[:, 1:]))
    offset = patches.points[index] - patches.points[:, None]
    tolerance = patches.thickness[:, None]
    theirs = (offset * patches.normals[index]).sum(dim=-1).abs()
    ours = (offset * patches.normals[:, None]).sum(dim=-1).abs()
    agree = near & (theirs < tolerance) & (ours < 2.0 * tolerance)
    return agree.sum(dim=1) > NEAREST // 2


def unobstructing(patches: Patches, cameras: RefractiveCamera, cell: int) -> Bool[Tensor, " n"]:
    """Which patches are not contradicted by what others see through them.

    cameras (m): of all views. In every view a patch falls into a cell. Patches that are seen there beyond it speak
    against it with their scores, those at its own distance for it, and it speaks for itself in every view that sees it.
    """
    against = torch.zeros_like(patches.score)
    favour = patches.score * patches.views
    for view in range(cameras.shape[0]):
        seen = patches.seen_by(view)
        if not bool(seen.any()):
            continue
        camera = cameras[view]
        pixels, valid = camera.project(patches.points, inside_image=True)
        rows = valid.nonzero()[:, 0]
        columns = camera.intrinsics.width // cell + 1
        at = (pixels[rows] / cell).long()
        depth = depth_in(camera, patches.points[rows])
        beyond, same = votes(
            at[:, 1] * columns + at[:, 0],
            depth,
            THICKNESS * patches.footprint[rows],
            torch.where(seen[rows], patches.score[rows], 0.0),
        )
        against[rows] += beyond
        favour[rows] += same
    return against <= favour


def votes(
    cells: Int[Tensor, " k"], depth: Float[Tensor, " k"], thickness: Float[Tensor, " k"], weight: Float[Tensor, " k"]
) -> tuple[Float[Tensor, " k"], Float[Tensor, " k"]]:
    """Weights of all others in the same cell that lie beyond each, and at its depth."""
    if not len(cells):
        return depth, depth
    low = depth.min()
    span = (depth.max() - low + 2.0 * thickness.max() + 1.0) * 1.01
    key = cells.double() * span + (depth - low)
    order = key.argsort()
    ordered = key[order]
    total = torch.cat((weight.new_zeros(1), weight[order].cumsum(dim=0)))
    start = torch.searchsorted(ordered, torch.maximum(key - thickness, cells * span - 0.5))
    behind = torch.searchsorted(ordered, key + thickness, right=True)
    end = torch.searchsorted(ordered, (cells + 1) * span - thickness.max() - 0.5)
    end = torch.maximum(end, behind)
    return total[end] - total[behind], total[behind] - total[start] - weight
