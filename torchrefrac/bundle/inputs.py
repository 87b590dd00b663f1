"""What a bundle adjustment cannot do anything with, refused before it begins."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Shaped
from torch import Tensor, bincount

from torchrefrac.checks import TorchrefracError
from torchrefrac.numerics import components
from torchrefrac.scene import Scene

SHOWN = 4
LOCATED = 2
"""Views with measured positions that hold a part of a scene in place."""


class UnadjustableError(TorchrefracError, ValueError):
    """The scene does not make an adjustment; the message says why."""


def check_inputs(
    scene: Scene,
    fixed: Bool[Tensor, "m 6"] | None = None,
    known: Bool[Tensor, " n"] | None = None,
    connected: bool = True,
    located: Bool[Tensor, " m"] | None = None,
) -> None:
    """Raise UnadjustableError for a scene of which not everything takes part, for values that are not finite, ids out
    of range, views that are not above their interface, points that fewer than two views see, views without any, and
    views that no chain of common points connects to the rest (unless their poses are fixed); SceneError for interfaces
    of several index ratios. known: points that have measurements of their own; these may be seen once. connected:
    whether such a chain is asked for. located: views whose positions are measured, LOCATED of which in each of two
    parts take the place of a chain between them.
    """
    views, seen = scene.views, scene.observations
    for name, mask in (("view", views.registered), ("point", scene.placed), ("observation", scene.accepted)):
        if not bool(mask.all()):
            raise UnadjustableError(f"not every {name} takes part; adjust `scene.part().scene`")
    _check_finite(scene)
    m, n = len(views), len(scene.points)
    for name, ids, count in (("view", seen.view, m), ("point", seen.point, n)):
        if len(ids) and (int(ids.min()) < 0 or int(ids.max()) >= count):
            raise UnadjustableError(f"observations.{name} has ids outside 0 to {count - 1}")
    broken = (~seen.pixels.isfinite()).any(dim=-1).nonzero()[:, 0]
    if len(broken):
        where = _listed([f"{i} ({views.names[int(seen.view[i])]})" for i in broken[:SHOWN].tolist()], len(broken))
        raise UnadjustableError(f"pixels are not finite in observation {where}; leave such observations out")
    height = scene.camera_heights()
    below = (height <= 0.0).nonzero()[:, 0] if scene.index_ratio > 1.0 else height[:0].long()
    if len(below):
        where = _listed([views.names[i] for i in below[:SHOWN].tolist()], len(below))
        raise UnadjustableError(
            f"not above the water plane: {where}; give the plane in the frame of the cameras, its normal towards them"
        )
    lonely = bincount(seen.point, minlength=n) < 2
    lonely = (lonely if known is None else lonely & ~known).nonzero()[:, 0]
    if len(lonely):
        where = _listed([str(i) for i in lonely[:SHOWN].tolist()], len(lonely))
        raise UnadjustableError(f"seen by fewer than two images: point {where}; leave such points out")
    if connected:
        _check_connected(scene, fixed, located)


def _check_finite(scene: Scene) -> None:
    values: dict[str, Shaped[Tensor, ...]] = {"points": scene.points}
    for table, names in (
        ("views", ("rotation", "center")),
        ("interfaces", ("normal", "offset", "index_ratio", "layers", "thickness")),
        ("cameras", ("focal", "principal_point", "distortion")),
    ):
        values |= {f"{table}.{name}": getattr(getattr(scene, table), name) for name in names}
    for name, value in values.items():
        if not bool(value.isfinite().all()):
            raise UnadjustableError(f"scene.{name} is not finite")


def _check_connected(scene: Scene, fixed: Bool[Tensor, "m 6"] | None, located: Bool[Tensor, " m"] | None) -> None:
    seen, m = scene.observations, len(scene.views)
    label = components(seen.view, seen.point + m, m + len(scene.points)).cpu().numpy()
    count = int(label.max()) + 1
    if count == 1:
        return
    parts = [np.nonzero(label[:m] == part)[0] for part in range(count)]
    sizes = sorted(parts, key=len, reverse=True)
    whole = np.zeros(m, dtype=bool) if fixed is None else fixed.all(dim=-1).cpu().numpy()
    placed = np.zeros(m, dtype=bool) if located is None else located.cpu().numpy()
    is_located = placed[sizes[0]].sum() >= LOCATED
    apart = [
        part
        for part in sizes[1:]
        if len(part) and not whole[part].all() and not (is_located and placed[part].sum() >= LOCATED)
    ]
    if apart:
        names = scene.views.names
        listed = "; ".join(_listed([names[int(i)] for i in part[:SHOWN]], len(part)) for part in apart[:SHOWN])
        raise UnadjustableError(
            f"no common points connect the images: {len(apart) + 1} parts, apart from the largest: {listed}; adjust "
            "the parts one by one"
        )


def _listed(shown: Sequence[str], count: int) -> str:
    more = count - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
