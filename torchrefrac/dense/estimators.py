"""The two ways to fill an image with patches."""

from collections.abc import Iterator
from typing import Protocol

from torchrefrac.dense.growth import Cells, grow
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.seeds import begin, cover, cover_repeated, matched_seeds, sparse_seeds
from torchrefrac.dense.sweeping.sweep import sweep
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
    """From a plane sweep over all distances, and outwards from what it finds. Cells that show what `maps` other images
    have found already get no patch."""
    cells = Cells(scope, options.cell)
    cover_repeated(scope, cells, known, options.maps)
    pixels, planes, _ = sweep(scope, options)
    at, inside = cells.index(pixels)
    at, planes = at[inside], planes[inside]
    for first in range(0, len(at), STEP):
        rows = slice(first, first + STEP)
        yield begin(scope, cells, at[rows], planes[rows], options), cells.newly_filled()
    for patches in grow(scope, cells, options):
        yield patches, cells.newly_filled()
