"""The two ways to fill an image with patches."""

from collections.abc import Iterator
from typing import Protocol

from torchrefrac.dense.growth import Cells, grow
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.seeds import begin, cover, matched_seeds, sparse_seeds
from torchrefrac.dense.sweep import sweep
from torchrefrac.scene import Reconstruction

STEP = 1 << 14  # cells of a sweep that are refined before they are reported


class Estimator(Protocol):
    """Finds the patches of one tile; yields them as they come, with how many cells have been filled since the last."""

    def __call__(
        self, scope: Scope, known: Patches, reconstruction: Reconstruction, options: DenseOptions
    ) -> Iterator[tuple[Patches, int]]: ...


def grow_patches(
    scope: Scope, known: Patches, reconstruction: Reconstruction, options: DenseOptions
) -> Iterator[tuple[Patches, int]]:
    """From seeds outwards (PMVS): first from known patches and sparse points, then from interest points in what is
    left. Cells that show a known patch get none."""
    cells = Cells(scope, options.cell)
    cover(scope, cells, known, options)
    yield sparse_seeds(scope, cells, reconstruction, options), cells.newly_filled()
    for patches in grow(scope, cells, options):
        yield patches, cells.newly_filled()
    yield matched_seeds(scope, cells, options), cells.newly_filled()
    for patches in grow(scope, cells, options):
        yield patches, cells.newly_filled()


def sweep_planes(
    scope: Scope, known: Patches, reconstruction: Reconstruction, options: DenseOptions
) -> Iterator[tuple[Patches, int]]:
    """Every cell, from a plane sweep over all distances; independent of all other images.

    Cells that have a patch already, from an earlier tile of the image, get no second one."""
    cells = Cells(scope, options.cell)
    mine = known[known.reference == int(scope.ids[0])]
    at, inside = cells.index(mine.pixels)
    cells.fill(at[inside], mine.points[inside], mine.normals[inside], mine.score[inside])
    cells.newly_filled()
    pixels, planes, _ = sweep(scope, options)
    at, inside = cells.index(pixels)
    for first in range(0, len(at), STEP):
        rows = slice(first, first + STEP)
        yield begin(scope, cells, at[rows], planes[rows], options, start_level=0), cells.newly_filled()
