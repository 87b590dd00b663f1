"""Views filled with patches in one of two ways, one after the other, or several at a time where they have nothing in
common."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, replace
from functools import partial

import torch

from torchrefrac.dense.growth import Cells, grow
from torchrefrac.dense.images import Images
from torchrefrac.dense.neighbours import MARGIN, Neighbourhood
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.overlap import may_see
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.scope import Scope, scopes
from torchrefrac.dense.seeds import cover, cover_repeated, matched_seeds, settle, sparse_seeds
from torchrefrac.dense.store import Store
from torchrefrac.dense.sweeping.sweep import sweep
from torchrefrac.numerics import CPU
from torchrefrac.recorder import Recorder

STEP = 1 << 14  # cells of a sweep that are refined before they are reported
CAREFUL = 0.5  # of the last step of an adjustment, where it begins from a sweep's guesses, which are farther off


@dataclass(frozen=True, eq=False)
class ViewJob:
    """All that the patches of one view depend on; it can be sent to another process.

    known: what earlier views have found that this one may see.
    """

    neighbourhood: Neighbourhood
    images: Images
    options: DenseOptions
    known: Patches

    @property
    def num_cells(self) -> int:
        height, width = self.images.size(int(self.neighbourhood.ids[0]))
        return (height // self.options.cell) * (width // self.options.cell)


def fill_view(job: ViewJob, report: Callable[[int, int], None] | None = None) -> Patches:
    """The patches of one view. Tells `report` how many more cells are filled, and patches found."""
    options, parts = job.options, [Patches.empty(job.options.views)]
    for scope in scopes(job.neighbourhood, job.images, options):
        cells, before = Cells(scope, options.cell), Patches.together([job.known, *parts])
        for patches in METHODS[options.method](scope, cells, before.to(scope.device), options):
            parts.append(patches.padded(options.views).to(CPU))
            if report is not None:
                report(cells.filled_since(), len(patches))
    return Patches.together(parts)


def fill_views(
    neighbourhoods: dict[int, Neighbourhood],
    images: Images,
    options: DenseOptions,
    recorder: Recorder,
    store: Store,
    executor: Executor | None = None,
) -> Patches:
    """The patches of all views, those with most sparse points first: what they find need not be found again.

    A view waits for those before it that may show what it sees, as the sparse points say, and knows nothing of the
    others. An `executor`, if there is one, has several views at a time where the photographs go on and on.
    """
    views = sorted(neighbourhoods, key=lambda view: -len(neighbourhoods[view].points))
    order = [neighbourhoods[view] for view in views]
    needs, found, none = _needs(order), dict[int, Patches](), Patches.empty(options.views)
    jobs = [ViewJob(neighbourhood, images, options, none) for neighbourhood in order]
    left = [job.num_cells for job in jobs]
    made, start = 0, time.perf_counter()
    with recorder.meter(sum(left), "densifying", "cell") as advance:

        def report(place: int, filled: int, patches: int) -> None:
            nonlocal made
            count = min(filled, left[place])  # tiles overlap
            made, left[place] = made + patches, left[place] - count
            advance(count, f"{made / (time.perf_counter() - start):.0f} patches/s")

        def job_of(place: int) -> ViewJob:
            known = Patches.together([none, *(found[earlier] for earlier in needs[place])])  # in memory, not in files
            return replace(jobs[place], known=known)

        for place, view in enumerate(views):
            if (stored := store.load(view)) is not None:
                found[place] = gathered([stored], len(stored), options.views, store)
                advance(left[place], "")
        waiting = [place for place in range(len(views)) if place not in found]
        if executor is None:
            finished = ((place, fill_view(job_of(place), partial(report, place))) for place in waiting)
        else:
            finished = _side_by_side(waiting, needs, found, job_of, executor)
        for step, (place, patches) in enumerate(finished, start=len(found)):
            found[place] = gathered([patches], len(patches), options.views, store)
            advance(left[place], "")
            store.save(views[place], patches)
            recorder.scalar("dense/patches", len(patches), step)
            recorder.scalar("dense/seconds", time.perf_counter() - start, step)
    parts = [found[place] for place in range(len(views))]
    return gathered(parts, sum(map(len, parts)), options.views, store)


def gathered(parts: Iterable[Patches], count: int, views: int, store: Store) -> Patches:
    """One table of several, `count` in all, compared with so many others, where the store has room."""
    table, first = store.room(count, views), 0
    for part in parts:
        table.put(first, part)
        first += len(part)
    return table


def _needs(order: Sequence[Neighbourhood]) -> list[list[int]]:
    """For each place in the order, the earlier ones that may show what it sees."""
    if not order:
        return []
    boxes = torch.stack([torch.stack((one.points.amin(dim=0), one.points.amax(dim=0))) for one in order])
    room = MARGIN * (boxes[:, 1] - boxes[:, 0])
    low, high = boxes[:, 0] - room, boxes[:, 1] + room
    return [
        may_see(one.cameras[0], low[:place], high[:place]).nonzero()[:, 0].tolist() for place, one in enumerate(order)
    ]


def _side_by_side(
    waiting: Sequence[int],
    needs: Sequence[Sequence[int]],
    found: Mapping[int, Patches],
    job_of: Callable[[int], ViewJob],
    executor: Executor,
) -> Iterator[tuple[int, Patches]]:
    """The waiting places with their patches as they are finished, each begun once all that it needs is `found`."""
    waiting, running = list(waiting), dict[Future[Patches], int]()
    while waiting or running:
        ready = [place for place in waiting if all(earlier in found for earlier in needs[place])]
        waiting = [place for place in waiting if place not in ready]
        running |= {executor.submit(fill_view, job_of(place)): place for place in ready}
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), future.result()


def grow_patches(scope: Scope, cells: Cells, known: Patches, options: DenseOptions) -> Iterator[Patches]:
    """From seeds outwards (PMVS): first from known patches and sparse points, then from interest points in what is
    left. Cells that show a known patch get none."""
    cover(scope, cells, known, options)
    yield from grow(scope, cells, options, sparse_seeds(scope, cells, options))
    yield from grow(scope, cells, options, matched_seeds(scope, cells, options))


def sweep_planes(scope: Scope, cells: Cells, known: Patches, options: DenseOptions) -> Iterator[Patches]:
    """From a plane sweep over all distances, and outwards from what it finds. Cells that show what `maps` other views
    have found already get no patch."""
    options = replace(options, last_step=CAREFUL * options.last_step)
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
