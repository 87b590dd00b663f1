"""Where patches begin: at the sparse points, at patches found from other images, and at matched interest points."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.dense.attempts import Attempts
from torchrefrac.dense.growth import Cells
from torchrefrac.dense.matching.epipolar_curve import find_candidates
from torchrefrac.dense.matching.interest_points import InterestPoints
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches, Planes
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.refine import attempt, compare, refine
from torchrefrac.dense.scope import Scope

MATCHED_IMAGES = 3  # in which candidates are looked for
BAND = 2.0  # pixels by which a candidate may lie off the curve
FIRST_SCORE = 0.5  # of a candidate whose slant is not yet known


def cover(scope: Scope, cells: Cells, known: Patches, options: DenseOptions) -> None:
    """Fill the cells in which a known patch is seen, without a new one: its own comparison has shown it, or the
    reference agrees about it, as it is, with an image that is known to see it. New patches grow from them, too."""
    pixels, at, facing, shown = _seen(scope, cells, known)
    rows = (facing & shown).nonzero()[:, 0]
    cells.fill(at[rows], known[rows])
    image = _where_seen(scope, known)
    rows = first_of_each(at, facing & ~shown & (image > 0) & ~cells.filled[at])
    planes = Planes(known.points[rows], known.normals[rows])
    score, good = compare(scope, pixels[rows], planes, image[rows], options)
    rows = rows[good]
    cells.fill(at[rows], replace(known[rows], score=score[good]))


def _where_seen(scope: Scope, known: Patches) -> Int[Tensor, " n"]:
    """For each known patch a local image that is known to see it, the best that there is; 0: none."""
    most = torch.cat((known.reference, known.others.flatten(), scope.ids)).max() + 1
    local = torch.zeros(int(most), dtype=torch.long, device=scope.device)
    local[scope.ids] = torch.arange(len(scope.ids), device=scope.device)
    images = torch.cat((local[known.reference][:, None], torch.where(known.visible, local[known.others], 0)), dim=1)
    return images.gather(1, (images > 0).long().argmax(dim=1, keepdim=True))[:, 0]


def cover_repeated(scope: Scope, cells: Cells, known: Patches, maps: int) -> None:
    """Fill the cells in which patches of `maps` other images have been shown to be seen, or one of the reference."""
    _, at, facing, shown = _seen(scope, cells, known)
    rows = (facing & shown).nonzero()[:, 0]
    mine = known.reference[rows] == scope.ids[0]
    pairs = torch.stack((at[rows], known.reference[rows]), dim=-1)[~mine].unique(dim=0)
    times = torch.bincount(pairs[:, 0], minlength=len(cells.filled))
    rows = rows[mine | (times[at[rows]] >= maps)]
    cells.fill(at[rows], known[rows])


def _seen(
    scope: Scope, cells: Cells, known: Patches
) -> tuple[Float[Tensor, "n 2"], Int[Tensor, " n"], Bool[Tensor, " n"], Bool[Tensor, " n"]]:
    """For each known patch the pixel and the cell that it lies in, whether it lies in one and faces the reference, and
    whether its own comparison has shown that the reference sees it."""
    camera = scope.cameras[0]
    pixels, valid = camera.project(known.points, inside_image=True)
    at, inside = cells.index(pixels)
    return pixels, at, valid & inside & known.facing(camera), known.seen_by(scope.ids[0])


def sparse_seeds(scope: Scope, cells: Cells, options: DenseOptions) -> Attempts:
    """Attempts at patches at the sparse points that the reference observes, where their cell is empty."""
    at, inside = cells.index(scope.pixels)
    facing = scope.cameras[0].center_in_world - scope.points
    return begin(scope, cells, at[inside], Planes(scope.points, facing)[inside], options)


def matched_seeds(scope: Scope, cells: Cells, options: DenseOptions) -> Attempts:
    """Attempts at patches at interest points of the reference in empty cells, matched along their epipolar curves
    (PMVS's seeds). Of an interest point's candidates in the best other images, the one on which most images agree best
    is taken."""
    ours = _interest_points(scope, 0)
    at, inside = cells.index(ours.pixels)
    rows = (inside & ~cells.filled[at]).nonzero()[:, 0]
    rays = PixelRays.cast(scope.cameras[0], ours.pixels[rows])
    near, far = (rays.origin.new_full((len(rows),), bound) for bound in (scope.near, scope.far))
    point, distance = [], []
    for other in range(1, 1 + min(MATCHED_IMAGES, scope.others)):
        theirs = _interest_points(scope, other)
        found = find_candidates(rays, ours.kind[rows], scope.cameras[other], theirs, near, far, BAND)
        point.append(found.point)
        distance.append(found.distance)
    point, distance = torch.cat(point), torch.cat(distance)
    points = rays[point].at(distance)
    planes = Planes(points, scope.cameras[0].center_in_world - points)
    pixels = ours.pixels[rows[point]]
    as_they_are = replace(options, iterations=0, min_score=FIRST_SCORE)
    seen, good = refine(scope, pixels, planes, as_they_are)
    best = good[(-seen.score * seen.views).argsort(stable=True)]
    return begin(scope, cells, at[rows[point[best]]], planes[best], options)


def begin(scope: Scope, cells: Cells, at: Int[Tensor, " k"], planes: Planes, options: DenseOptions) -> Attempts:
    """Attempts at one patch in each empty cell of `at`, with its first plane."""
    rows = first_of_each(at, ~cells.filled[at])
    return attempt(scope, at[rows], cells.pixels[at[rows]], planes[rows], options)


def settle(scope: Scope, cells: Cells, at: Int[Tensor, " k"], planes: Planes, options: DenseOptions) -> Patches:
    """Refine one patch in each empty cell of `at`, from its first plane, and fill the cells, but none beside them."""
    rows = first_of_each(at, ~cells.filled[at])
    patches, good = refine(scope, cells.pixels[at[rows]], planes[rows], options)
    cells.fill(at[rows[good]], patches)
    return patches


def first_of_each(cells: Int[Tensor, " n"], wanted: Bool[Tensor, " n"]) -> Int[Tensor, " k"]:
    """The first row of every cell among the `wanted` of rows that lie in `cells`."""
    rows = wanted.nonzero()[:, 0]
    order = cells[rows].argsort(stable=True)
    ordered = cells[rows[order]]
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return rows[order[first]]


def _interest_points(scope: Scope, image: int) -> InterestPoints:
    """Those of a local image that no mask covers."""
    found = scope.interest_points(int(scope.ids[image]))
    pixels = found.pixels.to(scope.device)
    allowed = scope.is_allowed(torch.full((len(pixels),), image, device=scope.device), pixels)
    return InterestPoints(pixels[allowed], found.kind.to(scope.device)[allowed])
