"""The dense reconstruction: patches image by image, then one surface without what contradicts it."""

import time
from collections.abc import Iterator
from typing import NamedTuple

import torch

from torchrefrac.checks import TorchrefracError
from torchrefrac.dense.depth_maps import depth_map
from torchrefrac.dense.estimators import Estimator, grow_patches, sweep_planes
from torchrefrac.dense.filtering import supported, unobstructing
from torchrefrac.dense.fusion import fuse
from torchrefrac.dense.images import Images
from torchrefrac.dense.neighbours import Neighbourhood, find_neighbours
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.store import NoStore, Store
from torchrefrac.dense.tiles import scopes
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Capture, DenseCloud, DepthMap, Reconstruction

ESTIMATORS: dict[str, Estimator] = {"patch": grow_patches, "depthmap": sweep_planes}


class DenseError(TorchrefracError, RuntimeError):
    """The photographs do not carry a dense reconstruction; the message says why and what would help."""


class Dense(NamedTuple):
    """The cloud, and the patches that it was made from, which know their images."""

    cloud: DenseCloud
    patches: Patches


def densify(
    capture: Capture,
    reconstruction: Reconstruction,
    options: DenseOptions | None = None,
    recorder: Recorder | None = None,
    store: Store | None = None,
) -> Dense:
    """Dense points of the surfaces that the registered images of a capture show.

    The reconstruction must have its points and observations: they say where to look. Textureless areas stay empty.
    Deterministic. `store` keeps finished images. Raises DenseError when no two images can be compared, CaptureError for
    an image or a mask that is missing or has another size, ValueError for the method none.
    """
    options = options or DenseOptions(method="patch")
    if options.method not in ESTIMATORS:
        raise ValueError(f"method is {options.method!r}, but must be {' or '.join(map(repr, ESTIMATORS))}")
    recorder, store = recorder or SilentRecorder(), store or NoStore()
    images = Images(capture)
    images.check()
    hoods = find_neighbours(reconstruction, options)
    if not hoods:
        raise DenseError(_nothing_to_compare(reconstruction))
    patches = _collect(hoods, reconstruction, images, options, recorder, store)
    with recorder.meter(4, "fusing", "") as advance:
        if options.method == "depthmap":
            patches = fuse(patches, reconstruction.cameras, options.cell, _fewest_maps(hoods, options))
        advance(1, "hidden patches")
        patches = patches[unobstructing(patches, reconstruction.cameras, options.cell)]
        advance(1, "lonely patches")
        patches = patches[supported(patches, options.cell)]
        advance(1, "colours")
        dense = Dense(_cloud(patches, images, reconstruction), patches)
        advance(1, f"{len(patches)} patches")
    recorder.scalar("dense/points", len(patches), 0)
    return dense


def depth_maps(dense: Dense, reconstruction: Reconstruction, options: DenseOptions) -> Iterator[DepthMap]:
    """What every registered image sees of the surface."""
    for image in reconstruction.registered.nonzero()[:, 0].tolist():
        camera, name = reconstruction.cameras[image], reconstruction.names[image]
        yield depth_map(dense.patches, camera, name, options.cell, reconstruction.length_unit)


def _collect(
    hoods: dict[int, Neighbourhood],
    reconstruction: Reconstruction,
    images: Images,
    options: DenseOptions,
    recorder: Recorder,
    store: Store,
) -> Patches:
    """The patches of all images, those that see most sparse points first."""
    seen = torch.bincount(reconstruction.image, minlength=len(reconstruction.names))
    order = sorted(hoods, key=lambda image: (-int(seen[image]), image))
    height, width = images.size
    cells = (height // options.cell) * (width // options.cell)
    known: list[Patches] = [Patches.empty(options.views)]
    made, start, home = 0, time.perf_counter(), torch.device("cpu")
    estimator = ESTIMATORS[options.method]
    with recorder.meter(len(order) * cells, "densifying", "cell") as advance:
        for step, image in enumerate(order):
            done = store.load(image)
            if done is not None:
                known.append(done)
                advance(cells, "")
                continue
            told, parts = 0, [Patches.empty(options.views)]
            for scope in scopes(image, hoods[image], reconstruction.cameras, images, options):
                before = Patches.together([*known, *parts]).to(scope.device)
                for patches, newly in estimator(scope, before, reconstruction, options):
                    parts.append(patches.padded(options.views).to(home))
                    filled = min(newly, cells - told)  # tiles overlap
                    made, told = made + len(patches), told + filled
                    advance(filled, f"{made / (time.perf_counter() - start):.0f} patches/s")
            advance(cells - told, "")
            found = Patches.together(parts)
            store.save(image, found)
            known.append(found)
            recorder.scalar("dense/patches", len(found), step)
            recorder.scalar("dense/seconds", time.perf_counter() - start, step)
    return Patches.together(known)


def _cloud(patches: Patches, images: Images, reconstruction: Reconstruction) -> DenseCloud:
    colors = torch.zeros(len(patches), 3, dtype=torch.uint8)
    for image in patches.reference.unique().tolist():
        rows = (patches.reference == image).nonzero()[:, 0]
        colors[rows] = images.colors(image, patches.pixels[rows])
    return DenseCloud(
        points=patches.points,
        normals=patches.normals,
        colors=colors,
        sigma=patches.sigma,
        score=patches.score,
        views=patches.views,
        reference=patches.reference,
        length_unit=reconstruction.length_unit,
    )


def _fewest_maps(hoods: dict[int, Neighbourhood], options: DenseOptions) -> int:
    """Images that must have found a surface each: two where only two can be compared."""
    return 2 if max(len(hood.others) for hood in hoods.values()) < 2 else min(options.min_views, 3) - 1


def _nothing_to_compare(reconstruction: Reconstruction) -> str:
    if not len(reconstruction.points):
        return "the reconstruction has no sparse points, which say where to look; run the sparse reconstruction first"
    center = reconstruction.center[reconstruction.registered]
    spread = float((center - center.mean(dim=0)).norm(dim=-1).max()) if len(center) else 0.0
    return (
        f"no two of {len(center)} registered images see common points at an angle of more than 1 degree (they stand "
        f"within {spread:.3g} {reconstruction.length_unit} of each other); take photographs from further apart"
    )
