"""Views filled with patches, one after the other, in one of two ways."""

import time
from collections.abc import Callable, Iterator

import torch

from torchrefrac.dense.growth import Cells, grow
from torchrefrac.dense.images import Images
from torchrefrac.dense.neighbours import Neighbourhood
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.scope import Scope, scopes
from torchrefrac.dense.seeds import cover, cover_repeated, matched_seeds, settle, sparse_seeds
from torchrefrac.dense.store import Store
from torchrefrac.dense.sweeping.sweep import sweep
from torchrefrac.recorder import Recorder

STEP = 1 << 14  # cells of a sweep that are refined before they are reported
HOME = torch.device("cpu")


def fill_views(
    neighbourhoods: dict[int, Neighbourhood], images: Images, options: DenseOptions, recorder: Recorder, store: Store
) -> Patches:
    """The patches of all views, those with most sparse points first: what they find need not be found again."""
    sizes = {view: images.size(view) for view in neighbourhoods}
    per_view = {view: (height // options.cell) * (width // options.cell) for view, (height, width) in sizes.items()}
    order = sorted(neighbourhoods.items(), key=lambda item: -len(item[1].points))
    known: list[Patches] = [Patches.empty(options.views)]
    made, start = 0, time.perf_counter()
    with recorder.meter(sum(per_view.values()), "densifying", "cell") as advance:
        for step, (view, neighbourhood) in enumerate(order):
            done = store.load(view)
            if done is not None:
                known.append(done)
                advance(per_view[view], "")
                continue
            left, parts = per_view[view], [Patches.empty(options.views)]
            for scope in scopes(neighbourhood, images, options):
                cells, before = Cells(scope, options.cell), Patches.together([*known, *parts]).to(scope.device)
                for patches in METHODS[options.method](scope, cells, before, options):
                    parts.append(patches.padded(options.views).to(HOME))
                    count = min(cells.filled_since(), left)  # tiles overlap
                    made, left = made + len(patches), left - count
                    advance(count, f"{made / (time.perf_counter() - start):.0f} patches/s")
            advance(left, "")
            found = Patches.together(parts)
            store.save(view, found)
            known.append(found)
            recorder.scalar("dense/patches", len(found), step)
            recorder.scalar("dense/seconds", time.perf_counter() - start, step)
    return Patches.together(known)


def grow_patches(scope: Scope, cells: Cells, known: Patches, options: DenseOptions) -> Iterator[Patches]:
    """From seeds outwards (PMVS): first from known patches and sparse points, then from interest points in what is
    left. Cells that show a known patch get none."""
    cover(scope, cells, known, options)
    yield from grow(scope, cells, options, sparse_seeds(scope, cells, options))
    yield from grow(scope, cells, options, matched_seeds(scope, cells, options))


def sweep_planes(scope: Scope, cells: Cells, known: Patches, options: DenseOptions) -> Iterator[Patches]:
    """From a plane sweep over all distances, and outwards from what it finds. Cells that show what `maps` other views
    have found already get no patch."""
    cover_repeated(scope, cells, known, options.maps)
    pixels, planes, _ = sweep(scope, options)
    at, inside = cells.index(pixels)
    at, planes = at[inside], planes[inside]
    for first in range(0, len(at), STEP):
        rows = slice(first, first + STEP)
        yield settle(scope, cells, at[rows], planes[rows], options)
    yield from grow(scope, cells, options)


METHODS: dict[str, Callable[[Scope, Cells, Patches, DenseOptions], Iterator[Patches]]] = {
    "patch": grow_patches,
    "depthmap": sweep_planes,
}
"""How the cells of a tile are filled beside known patches; the new ones come as they are found."""
