"""The scene of a run in three dimensions, as a page that is turned by hand.

Points are 16 bits a coordinate in the box that holds all but stray ones, and 8 bits a colour and a standard deviation.
"""

import base64
import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from torchrefrac.figures.cameras import pyramids
from torchrefrac.figures.plotting import height_colors
from torchrefrac.files.dense import DenseFile
from torchrefrac.files.ply import DenseFileError
from torchrefrac.files.run import DENSE_CLOUD, REPORT, SCENE_PAGE
from torchrefrac.html.contents import RunContents
from torchrefrac.html.page import write_page
from torchrefrac.html.words import capital, counted, job_name
from torchrefrac.numerics.permutation import permuted
from torchrefrac.scene import Interfaces, Scene
from torchrefrac.scene.wording import Wording

MOST_BYTES, PAGE_BYTES = 8_000_000, 100_000  # of the page, and of it without points and cameras
POINT_BYTES, CAMERA_BYTES = 40.0 / 3.0, 80.0  # of base64
TAILS, LEAST_SHARE = (0.005, 0.995), 0.002  # of points beyond the ends of a scale, and beyond the box but for a margin
STEPS = 65535, 255
DENSE, SPARSE = "dense", "sparse"
SMALLEST = {DENSE: 1.5, SPARSE: 3.0}  # diameter of a point, in pixels
LEVEL, UPRIGHT = 0.0, math.pi / 2.0


class Points(NamedTuple):
    """What is shown of the points of a run, in its frame: some of `total`, which are dense or sparse. sigma: of each,
    where that is known."""

    kind: str
    total: int
    position: Float[Tensor, "n 3"]
    colors: UInt8[Tensor, "n 3"]
    sigma: Float[Tensor, " n"] | None


def write_scene_page(run: RunContents) -> Path | None:
    """Write the page into the folder of a run: cameras, the first surface where it stands still, and the dense points,
    or the sparse ones where there are no others, as many as fit into MOST_BYTES.

    Returns its path; None where the run has no cameras. Raises OSError where it cannot be written.
    """
    scene, words = run.scene, run.own_words
    if scene is None or not bool(scene.views.registered.any()):
        return None
    cameras = scene.views.num_registered
    points = _points(run.record.folder, scene, int((MOST_BYTES - PAGE_BYTES - CAMERA_BYTES * cameras) / POINT_BYTES))
    frame = _frame(words)
    pyramid = _cameras(scene)
    seen, corners = points.position @ frame.mT, pyramid @ frame.mT
    low, high = _box(torch.cat((seen, corners[:, 0])))
    middle = 0.5 * (low + high)
    start, end = _box(seen) if len(seen) else (low, high)
    extent = (end - start).clamp(min=1e-9)
    surfaces = _surfaces(scene.interfaces, torch.cat((points.position, pyramid[:, 0]))) @ frame.mT - middle
    shown = f"{counted(cameras)} {'camera' if cameras == 1 else 'cameras'} and {_counted(points)}"
    scales = _scales(points, seen, middle, words, scene.length_unit)
    write_page(
        "scene.html",
        run.record.folder / SCENE_PAGE,
        title=job_name(run.record),
        shown=shown,
        report=REPORT,
        surface=words.surface if len(surfaces) else "",
        along_z=words.along_z,
        scales=scales,
        arrays={
            "positions": _coded(((seen - start) / extent * STEPS[0]).round(), "<u2"),
            "colors": _coded(points.colors, "u1"),
            "sigma": _coded(_shares(points.sigma), "u1"),
            "map": _coded(torch.tensor(height_colors().colors, dtype=torch.float64)[:, :3] * STEPS[1], "u1"),
            "pyramids": _coded(corners - middle, "<f4"),
        },
        about={
            "origin": (start - middle).tolist(),
            "extent": extent.tolist(),
            "radius": float((high - low).norm()) / 2.0,
            "spacing": float(extent.sort().values[1:].prod() / len(seen)) ** 0.5 if points.kind == DENSE else 0.0,
            "least": SMALLEST[points.kind],
            "surfaces": surfaces.tolist(),
            "scales": scales,
            "along": {"turn": LEVEL, "rise": LEVEL if words.is_wall else UPRIGHT},
            "side": {"turn": -UPRIGHT if words.is_wall else LEVEL, "rise": LEVEL},
        },
    )
    return run.record.folder / SCENE_PAGE


def _points(folder: Path, scene: Scene, most: int) -> Points:
    """Without those that lie far from all others."""
    try:
        file = DenseFile(folder / DENSE_CLOUD)
    except DenseFileError:
        rows = _some(len(scene.points), most)
        sigma = scene.assessment.point_sigma
        known = None if sigma is None else sigma[rows]
        points = Points(SPARSE, len(scene.points), scene.points[rows], scene.colors[rows], known)
    else:
        cloud = file[_some(len(file), most)]
        points = Points(DENSE, len(file), cloud.points, cloud.colors, cloud.sigma)
    if not len(points.position):
        return points
    near = _near(points.position)
    return points._replace(
        position=points.position[near],
        colors=points.colors[near],
        sigma=None if points.sigma is None else points.sigma[near],
    )


def _some(count: int, most: int) -> Shaped[Tensor, " n"]:
    """Indices of as many of `count` rows, in their order, at random."""
    return torch.arange(count) if count <= most else permuted(torch.arange(most), count, seed=0).sort().values


def _box(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Two corners of what holds all points but stray ones: those that are beyond nearly all by more than these are
    apart."""
    ends = points.new_tensor((LEAST_SHARE, 1.0 - LEAST_SHARE))
    low, high = points.quantile(ends, dim=0)
    margin = (high - low).max()
    return points.amin(dim=0).maximum(low - margin), points.amax(dim=0).minimum(high + margin)


def _near(points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Those that are not stray."""
    low, high = _box(points)
    return ((points >= low) & (points <= high)).all(dim=-1)


def _frame(words: Wording) -> Float[Tensor, "3 3"]:
    """Rows right, away from the viewer and up; before a wall y is up, and z points at the viewer."""
    if words.is_wall:
        return torch.tensor(((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)), dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64)


def _cameras(scene: Scene) -> Float[Tensor, "m 5 3"]:
    """The apex of each registered camera's pyramid, and its corners."""
    sides = pyramids(scene).unflatten(0, (-1, 4))
    return torch.cat((sides[:, :1, 0], sides[:, :, 1]), dim=1)


def _surfaces(interfaces: Interfaces, around: Float[Tensor, "n 3"]) -> Float[Tensor, "k 4 3"]:
    """Corners of first surfaces that stand still, as far as there are points and cameras before or behind them."""
    if not interfaces.stand_in_world:
        return around.new_zeros(0, 4, 3)
    planes = torch.cat((interfaces.normal, interfaces.offset[:, None]), dim=-1).unique(dim=0)
    normal, offset = planes[:, :3], planes[:, 3]
    away = around.new_tensor((0.0, 1.0, 0.0)) - normal[:, 1:2] * normal
    up = away / away.norm(dim=-1, keepdim=True)
    axes = torch.stack((torch.linalg.cross(up, normal), up), dim=1)
    across = torch.einsum("kij,nj->kni", axes, around[_near(around)])
    start, end = across.amin(dim=1), across.amax(dim=1)
    share = around.new_tensor(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)))
    corners = start[:, None] + share * (end - start)[:, None]
    return corners @ axes + (offset[:, None] * normal)[:, None]


def _scales(
    points: Points, seen: Float[Tensor, "n 3"], middle: Float[Tensor, " 3"], words: Wording, unit: str
) -> list[dict[str, Any]]:
    """What colours may stand for beside the photographs': its name, and how the page finds it for each point: `sign`
    times a coordinate and `middle`, or a share of the highest standard deviation; low and high: the ends of the
    colours, the dark one at the right where they are reversed."""
    if not len(seen):
        return []
    axis, sign = (1, 1.0) if words.is_wall else (2, -1.0 if words.depth else 1.0)
    low, high = (sign * seen[:, axis]).quantile(seen.new_tensor(TAILS)).tolist()
    along = {
        "name": "depth" if words.depth else words.z,
        "label": f"{words.depth or capital(words.z)} ({unit})",
        "axis": axis,
        "sign": sign,
        "middle": sign * float(middle[axis]),
        "low": low,
        "high": max(high, low + 1e-9),
        "reversed": bool(words.depth),
    }
    if points.sigma is None:
        return [along]
    known = {"name": "sigma", "label": f"Standard deviation ({unit})", "axis": None, "low": 0.0, "reversed": False}
    return [along, known | {"high": _highest(points.sigma)}]


def _highest(sigma: Float[Tensor, " n"]) -> float:
    """The end of the scale of standard deviations."""
    finite = sigma[sigma.isfinite()]
    return float(finite.quantile(TAILS[1])) if len(finite) else 1.0


def _shares(sigma: Float[Tensor, " n"] | None) -> Float[Tensor, " m"]:
    """Of standard deviations, in steps of the scale; those that are beyond it, or not finite, at its end."""
    if sigma is None:
        return torch.zeros(0, dtype=torch.float64)
    share = sigma / max(_highest(sigma), 1e-30)
    return (STEPS[1] * share.nan_to_num(1.0, 1.0, 1.0).clamp(0.0, 1.0)).round()


def _counted(points: Points) -> str:
    shown = len(points.position)
    some = "" if shown == points.total else f"{counted(shown)} of "
    return f"{some}{counted(points.total)} {points.kind} points"


def _coded(values: Shaped[Tensor, "..."], kind: str) -> str:
    return base64.b64encode(values.numpy().astype(kind).tobytes()).decode("ascii")
