"""The patches of views that were each filled on their own as one surface, and which of these contradict others: they
hide what is seen through them, or stand alone, one or few (PMVS's filters)."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.overlap import Finds
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.rays import depth_in
from torchrefrac.dense.vicinity import NEAREST, Vicinity, vicinities
from torchrefrac.numerics import components, joined

SAME_REACH = 3.0  # cells within which the patch of another view must lie to be the same
ISLAND = 30  # patches; fewer that hang together, away from all others, are a mistake that grew
THICKNESS = 4.0  # footprints within which two patches in one line of sight are the same surface


def fuse(patches: Patches, cameras: RefractiveCamera, cell: int, min_maps: int) -> Patches:
    """Patches that at least `min_maps` views found, each once, at the mean of what these views found.

    cameras (m): of all views. A patch is found again by a view whose own patch in that place lies in the same plane.
    The mean is taken along the normal, weighted by 1 / sigma^2; sigma stays that of the better patch, as they share
    photographs.
    """
    finds = Finds.of(patches, cameras)
    tables = _tables(finds, cameras, cell)
    taken = torch.zeros(len(patches), dtype=torch.bool)
    chosen, points, sigma = [], [], []
    for image in range(cameras.shape[0]):
        rows = finds.found_by(image)
        rows = rows[~taken[rows]]
        weight = patches.sigma[rows].square().reciprocal()
        total, moved = weight.clone(), torch.zeros_like(weight)
        best, maps = patches.sigma[rows], torch.ones_like(rows)
        found = []
        for other in range(cameras.shape[0]):
            if other == image or not bool(finds.sees[other, image]):
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


def _tables(finds: Finds, cameras: RefractiveCamera, cell: int) -> list[Int[Tensor, "rows columns"]]:
    """For every view, the patch of each of its cells, -1 where there is none."""
    width, height = cameras.intrinsics.width, cameras.intrinsics.height
    tables = []
    for image in range(cameras.shape[0]):
        rows = finds.found_by(image)
        table = torch.full((height // cell + 1, width // cell + 1), -1, dtype=torch.int32)
        column, row = (finds.patches.pixels[rows] / cell).long().unbind(dim=-1)
        table[row, column] = rows.int()
        tables.append(table)
    return tables


def _found_again(
    patches: Patches, rows: Int[Tensor, " k"], camera: RefractiveCamera, table: Int[Tensor, "rows columns"], cell: int
) -> tuple[Int[Tensor, " k"], Float[Tensor, " k"], Bool[Tensor, " k"]]:
    """The other view's patch where each of `rows` is seen, how far its plane is along the normal, and whether the two
    are the same surface."""
    pixels, valid = camera.project(patches.points[rows], inside_image=True)
    column, row = (pixels / cell).long().unbind(dim=-1)
    match = table[row.clamp(0, table.shape[0] - 1), column.clamp(0, table.shape[1] - 1)].long()
    valid = valid & (match >= 0)
    match = match.clamp(min=0)
    apart = patches.points[match] - patches.points[rows]
    turned = (patches.normals[match] * patches.normals[rows]).sum(dim=-1)
    valid = valid & (turned > 0.5)
    offset = (apart * patches.normals[match]).sum(dim=-1) / torch.where(valid, turned, 1.0)
    near = apart.norm(dim=-1) < SAME_REACH * cell * torch.maximum(patches.footprint[rows], patches.footprint[match])
    thickness = torch.maximum(patches.thickness_of(rows), patches.thickness_of(match))
    return match, offset, valid & near & (offset.abs() < thickness)


def supported(patches: Patches, cell: int, rows: Int[Tensor, " n"] | None = None) -> Bool[Tensor, " n"]:
    """Which of some patches (of all) lie on the planes of most of their neighbours among them, and these on theirs."""
    rows = torch.arange(len(patches)) if rows is None else rows
    good = torch.ones(len(rows), dtype=torch.bool)
    if len(rows) > NEAREST:
        for around in vicinities(patches, rows, cell):
            good[around.rows] = _agreeing(patches, rows, around) > NEAREST // 2
    return good


def _agreeing(patches: Patches, rows: Int[Tensor, " n"], around: Vicinity) -> Int[Tensor, " k"]:
    """How many of the neighbours of some patches lie on their planes, and they on theirs."""
    here, others = rows[around.rows], rows[around.others]
    offset = patches.points[others] - patches.points[here, None]
    tolerance = patches.thickness_of(here)[:, None]
    theirs = (offset * patches.normals[others]).sum(dim=-1).abs()
    ours = (offset * patches.normals[here, None]).sum(dim=-1).abs()
    return (around.near & (theirs < tolerance) & (ours < 2.0 * tolerance)).sum(dim=1)


def of_surfaces(patches: Patches, cell: int, rows: Int[Tensor, " n"] | None = None) -> Bool[Tensor, " n"]:
    """Which of some patches (of all) hang together with ISLAND others of them and more, or with as many as any do where
    all are fewer."""
    rows = torch.arange(len(patches)) if rows is None else rows
    if len(rows) <= NEAREST:
        return torch.ones(len(rows), dtype=torch.bool)
    pairs = []
    for around in vicinities(patches, rows, cell):
        first, second = joined(around.rows[around.near.nonzero()[:, 0]], around.others[around.near])
        pairs.append(torch.stack((first, second)).int())
    first, second = torch.cat(pairs, dim=1)
    island = components(first, second, len(rows))
    size = torch.bincount(island)
    return (size >= min(ISLAND, int(size.max())))[island]


def unobstructing(patches: Patches, cameras: RefractiveCamera, cell: int) -> Bool[Tensor, " n"]:
    """Which patches are not contradicted by what others see through them.

    cameras (m): of all views. In every view a patch falls into a cell. Patches that are seen there beyond it speak
    against it with their scores, those at its own distance for it, and it speaks for itself in every view that sees it.
    """
    against = torch.zeros_like(patches.score)
    favour = patches.score * patches.views
    finds = Finds.of(patches, cameras)
    for view in range(cameras.shape[0]):
        near, some = finds.seen_by(view)
        seen = some.seen_by(view)
        if not bool(seen.any()):
            continue
        camera = cameras[view]
        pixels, valid = camera.project(some.points, inside_image=True)
        rows = valid.nonzero()[:, 0]
        columns = camera.intrinsics.width // cell + 1
        at = (pixels[rows] / cell).long()
        depth = depth_in(camera, some.points[rows])
        beyond, same = votes(
            at[:, 1] * columns + at[:, 0],
            depth,
            THICKNESS * some.footprint[rows],
            torch.where(seen[rows], some.score[rows], 0.0),
        )
        against[near[rows]] += beyond
        favour[near[rows]] += same
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
