"""What a bundle adjustment cannot do anything with, said before it begins."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchrefrac.bundle.state import BundleState, Links, Observations
from torchrefrac.checks import TorchrefracError

SHOWN = 4


class UnadjustableError(TorchrefracError, ValueError):
    """Observations and state do not make an adjustment; the message says which."""


def check_inputs(
    state: BundleState,
    observations: Observations,
    links: Links,
    held: Tensor | None = None,
    names: Sequence[str] | None = None,
    known: Tensor | None = None,
) -> None:
    """Raise UnadjustableError for a state or pixels that are not finite, ids out of range, cameras that are not above
    their water plane, points that fewer than two images see, images without any, and images that no chain of common
    points connects to the rest (unless their poses are held). names (m): of the images, for the
    messages. known (n): points that have measurements of their own; these may be seen once.
    """
    told = tuple(f"camera {i}" for i in range(len(state.center))) if names is None else tuple(names)
    _check_finite(state)
    m, n = len(state.center), len(state.points)
    camera, point = observations.camera, observations.point
    for name, ids, count in (("camera", camera, m), ("point", point, n)):
        if len(ids) and (int(ids.min()) < 0 or int(ids.max()) >= count):
            raise UnadjustableError(f"observations.{name} has ids outside 0 to {count - 1}")
    broken = (~observations.pixels.isfinite()).any(dim=-1).nonzero()[:, 0]
    if len(broken):
        where = _listed([f"{i} ({told[int(camera[i])]})" for i in broken[:SHOWN].tolist()], len(broken))
        raise UnadjustableError(f"pixels are not finite in observation {where}; leave such observations out")
    normal, offset = state.planes
    height = (normal[links.plane] * state.center).sum(dim=-1) - offset[links.plane]
    below = (height <= 0.0).nonzero()[:, 0] if float(state.index_ratio) > 1.0 else height[:0].long()
    if len(below):
        where = _listed([told[i] for i in below[:SHOWN].tolist()], len(below))
        raise UnadjustableError(
            f"not above the water plane: {where}; give the plane in the frame of the cameras, its normal towards them"
        )
    seen = torch.bincount(point, minlength=n)
    lonely = ((seen < 2) if known is None else (seen < 2) & ~known).nonzero()[:, 0]
    if len(lonely):
        where = _listed([str(i) for i in lonely[:SHOWN].tolist()], len(lonely))
        raise UnadjustableError(f"seen by fewer than two images: point {where}; leave such points out")
    _check_connected(camera, point, m, n, held, told)


def _check_finite(state: BundleState) -> None:
    values = {
        name: getattr(state, name) for name in ("rotation", "center", "points", "index_ratio", "normal", "offset")
    }
    values |= {f"lens.{name}": getattr(state.lens, name) for name in ("focal", "principal_point", "distortion")}
    for name, value in values.items():
        if not bool(value.isfinite().all()):
            raise UnadjustableError(f"state.{name} is not finite")


def _check_connected(camera: Tensor, point: Tensor, m: int, n: int, held: Tensor | None, names: Sequence[str]) -> None:
    edges = (np.ones(len(camera)), (camera.cpu().numpy(), point.cpu().numpy() + m))
    count, label = connected_components(coo_array(edges, shape=(m + n, m + n)), directed=False)
    if count == 1:
        return
    parts = [np.nonzero(label[:m] == part)[0] for part in range(count)]
    sizes = sorted(parts, key=len, reverse=True)
    fixed = np.zeros(m, dtype=bool) if held is None else held.all(dim=-1).cpu().numpy()
    apart = [part for part in sizes[1:] if len(part) and not fixed[part].all()]
    if apart:
        told = "; ".join(_listed([names[int(i)] for i in part[:SHOWN]], len(part)) for part in apart[:SHOWN])
        raise UnadjustableError(
            f"no common points connect the images: {len(apart) + 1} parts, apart from the largest: {told}; adjust the "
            "parts one by one"
        )


def _listed(shown: Sequence[str], count: int) -> str:
    more = count - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")
