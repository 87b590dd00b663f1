"""The dense reconstruction: patches view by view, then one surface without what contradicts it; what each view sees of
that."""

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.checks import TorchrefracError
from torchrefrac.dense.common_errors import common_deviations
from torchrefrac.dense.filling import METHODS, fill_views, gathered
from torchrefrac.dense.fusion import THICKNESS, fuse, of_surfaces, supported, unobstructing
from torchrefrac.dense.images import Images, photographs
from torchrefrac.dense.media import PartOfStore, media_of
from torchrefrac.dense.neighbours import Neighbourhood, find_neighbours
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.overlap import Finds
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.rays import PixelRays, depth_in
from torchrefrac.dense.store import NoStore, Store
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import DenseCloud, DepthMap, Scene

AT_ONCE = 1 << 16  # patches that are copied, or whose rays are cast


class DenseError(TorchrefracError, RuntimeError):
    """The photographs do not carry a dense reconstruction; the message says why and what would help."""


class Dense(NamedTuple):
    """The cloud, and the patches that it was made from, which know their views: those under water and above it, and
    those that lie below its level, but outside."""

    cloud: DenseCloud
    patches: Patches
    outside: Patches


def densify(
    scene: Scene,
    options: DenseOptions | None = None,
    recorder: Recorder | None = None,
    store: Store | None = None,
    executor: Executor | None = None,
) -> Dense:
    """Dense points of the surfaces that the registered views show.

    The scene must have its points and observations, which say where to look, and its `capture`, the photographs.
    Textureless areas stay empty. What lies outside the water is looked for straight, see `media_of`.
    Deterministic. Finished views go to `store`. An `executor` works on several views at a time, each when those that
    it has to know of are finished (see `fill_views`), with the same result. Raises DenseError when no two views can be
    compared, CaptureError for an image or a mask that is missing or has another size, ValueError for the method none.
    """
    options = options or DenseOptions(method="patch")
    if options.method not in METHODS:
        raise ValueError(f"method is {options.method!r}, but must be {' or '.join(map(repr, METHODS))}")
    recorder, capture, store = recorder or SilentRecorder(), photographs(scene), store or NoStore()
    media, parts = media_of(scene), [Patches.empty(options.views) for _ in range(2)]
    pictures = [Images(capture, where=medium.where) for medium in media]
    pictures[0].check()
    neighbourhoods = [find_neighbours(medium.scene, options) for medium in media]
    if not any(neighbourhoods):
        raise DenseError(_nothing_to_compare(scene))
    for i, (medium, images, around) in enumerate(zip(media, pictures, neighbourhoods, strict=True)):
        if around:
            own = PartOfStore(store, i * len(scene.views)) if i else store
            parts[i] = _surface(medium.scene, images, around, options, recorder, own, executor)
    patches = gathered(parts, sum(map(len, parts)), options.views, store) if len(media) > 1 else parts[0]
    colors = pictures[0].colors(patches.reference, patches.pixels)
    recorder.scalar("dense/points", len(patches), 0)
    rays = torch.cat([_rays(part, medium.scene) for part, medium in zip(parts, media, strict=False)])
    common = common_deviations(patches.points, scene)
    return Dense(patches.cloud(colors, rays, common, scene.length_unit), *parts)


def _rays(patches: Patches, scene: Scene) -> Float[Tensor, "n 3"]:
    """Directions of the viewing rays at the patches."""
    directions = torch.empty_like(patches.points)
    for rows in torch.arange(len(patches)).split(AT_ONCE):
        rays = PixelRays.cast(scene.camera_of(patches.reference[rows]), patches.pixels[rows])
        directions[rows] = rays.direction_at(rays.distance_of(patches.points[rows]))
    return directions


def _surface(
    scene: Scene,
    images: Images,
    neighbourhoods: dict[int, Neighbourhood],
    options: DenseOptions,
    recorder: Recorder,
    store: Store,
    executor: Executor | None,
) -> Patches:
    """The patches in one medium that nothing contradicts."""
    cameras = scene.camera_of()
    patches = fill_views(neighbourhoods, images, options, recorder, store, executor)
    with recorder.meter(3, "fusing", "") as advance:
        if options.method == "depthmap":
            only_pairs = max(len(one.ids) for one in neighbourhoods.values()) == 2
            patches = fuse(patches, cameras, options.cell, 2 if only_pairs else min(options.min_views, 3) - 1)
        advance(1, "hidden patches")
        rows = unobstructing(patches, cameras, options.cell).nonzero()[:, 0]
        advance(1, "lonely patches")
        rows = rows[supported(patches, options.cell, rows)]
        rows = rows[of_surfaces(patches, options.cell, rows)]
        chosen = gathered((patches[some] for some in rows.split(AT_ONCE)), len(rows), options.views, store)
        advance(1, f"{len(rows)} patches")
    return chosen


def depth_maps(dense: Dense, scene: Scene, options: DenseOptions) -> Iterator[DepthMap]:
    """What every registered view sees of the surface."""
    cameras = scene.camera_of()
    finds, outside = Finds.of(dense.patches, cameras), Finds.of(dense.outside, cameras.as_pinhole())
    for view in scene.views.registered.nonzero()[:, 0].tolist():
        camera, about = cameras[view], (scene.views.names[view], options.cell, scene.length_unit)
        seen = depth_map(finds.seen_by(view)[1], camera, *about)
        if len(dense.outside):
            seen = nearer(seen, depth_map(outside.seen_by(view)[1], camera.as_pinhole(), *about))
        yield seen


def nearer(first: DepthMap, second: DepthMap) -> DepthMap:
    """In each cell what the nearer of two maps of one view has."""
    take = second.valid & (~first.valid | (second.depth < first.depth))
    return replace(
        first,
        points=torch.where(take[..., None], second.points, first.points),
        depth=torch.where(take, second.depth, first.depth),
        sigma=torch.where(take, second.sigma, first.sigma),
        valid=first.valid | second.valid,
    )


def depth_map(patches: Patches, camera: RefractiveCamera, name: str, cell: int, length_unit: str) -> DepthMap:
    """The nearest patch in each cell, met by the ray of the cell's centre."""
    intrinsics = camera.intrinsics
    rows, columns = intrinsics.height // cell, intrinsics.width // cell
    pixels, valid = camera.project(patches.points, inside_image=True)
    column, row = (pixels / cell).long().unbind(dim=-1)
    use = (valid & patches.facing(camera) & (column < columns) & (row < rows)).nonzero()[:, 0]
    at, depth = (row * columns + column)[use], depth_in(camera, patches.points[use])
    nearest = torch.full((rows * columns,), torch.inf, dtype=depth.dtype).scatter_reduce(0, at, depth, "amin")
    around = -torch.nn.functional.max_pool2d(-nearest.view(1, 1, rows, columns), 3, stride=1, padding=1).flatten()
    front = (depth == nearest[at]) & (depth <= around[at] + THICKNESS * cell * patches.footprint[use])
    at, use = at[front], use[front]
    centers = torch.stack((at % columns + 0.5, at // columns + 0.5), dim=-1) * cell
    rays = PixelRays.cast(camera, centers)
    points = rays.at(rays.meet(patches.points[use], patches.normals[use]))
    close = (points - patches.points[use]).norm(dim=-1) < 2.0 * cell * patches.footprint[use]
    points = torch.where(close[:, None], points, patches.points[use])

    def spread(values: Shaped[Tensor, "k *rest"]) -> Shaped[Tensor, "rows columns *rest"]:
        table = values.new_zeros(rows * columns, *values.shape[1:])
        table[at] = values
        return table.view(rows, columns, *values.shape[1:])

    return DepthMap(
        name=name,
        step=cell,
        points=spread(points),
        depth=spread(depth_in(camera, points)),
        sigma=spread(patches.sigma[use]),
        valid=spread(torch.ones_like(at, dtype=torch.bool)),
        length_unit=length_unit,
    )


def _nothing_to_compare(scene: Scene) -> str:
    if not len(scene.points):
        return "the scene has no sparse points, which say where to look; run the sparse reconstruction first"
    center = scene.views.center[scene.views.registered]
    spread = float((center - center.mean(dim=0)).norm(dim=-1).max()) if len(center) else 0.0
    return (
        f"no two of {len(center)} registered images see common points at an angle of more than 1 degree (they stand "
        f"within {spread:.3g} {scene.length_unit} of each other); take photographs from further apart"
    )
