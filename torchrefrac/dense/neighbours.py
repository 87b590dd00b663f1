"""Which views to compare with which, and between which distances to look, as the sparse points say."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.rays import PixelRays
from torchrefrac.scene import Scene

MARGIN = 0.25  # of the range of distances of the sparse points, added at either end
MIN_POINTS = 5
MIN_ANGLE = 1.0  # degrees; below, two images say nothing about distance


@dataclass(frozen=True)
class Neighbourhood:
    """A reference view, the views that it is compared with, and what is known of the surface that it shows.

    ids: which views of the scene these are, the reference first, then the others, best first; cameras (v): theirs;
    near, far: distances along the reference's rays (see `PixelRays`); points: those that it observes, at pixels.
    """

    ids: Int[Tensor, " v"]
    cameras: RefractiveCamera
    near: float
    far: float
    points: Float[Tensor, "k 3"]
    pixels: Float[Tensor, "k 2"]


def find_neighbours(scene: Scene, options: DenseOptions) -> dict[int, Neighbourhood]:
    """Of every registered view that shares points with another one at a useful angle.

    A view's worth to another is the sum over common points of how near the angle between their rays is to the best.
    """
    cameras, seen, center = scene.camera_of(), scene.observations, scene.views.center
    cameras = replace(cameras, intrinsics=cameras.intrinsics.without_idle_distortion(), check=False)
    shared = torch.zeros(len(scene.points), len(scene.views), dtype=torch.bool)
    shared[seen.point, seen.view] = True
    found: dict[int, Neighbourhood] = {}
    for view in scene.views.registered.nonzero()[:, 0].tolist():
        mine = seen[seen.view == view]
        if len(mine) < MIN_POINTS:
            continue
        points = scene.points[mine.point]
        fits = fitness(angle_between(center[:, None], center[view], points), options)
        fits = torch.where(shared[mine.point].T, fits, 0.0)
        fits[view] = 0.0
        worth = fits.sum(dim=1) * scene.views.registered
        order = worth.argsort(descending=True, stable=True)[: options.neighbours]
        others = order[worth[order] > 0.0]
        if len(others):
            ids = torch.cat((torch.tensor([view]), others))
            found[view] = Neighbourhood(ids, cameras[ids], *_range(cameras[view], points), points, mine.pixels)
    return found


def angle_between(
    first: Float[Tensor, "*#batch 3"], second: Float[Tensor, "*#batch 3"], points: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch"]:
    """Degrees between the straight lines from points to two centres."""
    a, b = (torch.nn.functional.normalize(center - points, dim=-1) for center in (first, second))
    return torch.rad2deg(torch.acos((a * b).sum(dim=-1).clamp(-1.0, 1.0)))


def fitness(angle: Float[Tensor, "*batch"], options: DenseOptions) -> Float[Tensor, "*batch"]:
    """How well two images go together whose rays meet at an angle in degrees: 1 at the best angle, less to either side,
    0 where nothing is to be learnt."""
    fits = torch.minimum(angle / options.angle_best, options.angle_best / angle.clamp(min=MIN_ANGLE))
    return torch.where((angle > MIN_ANGLE) & (angle < options.angle_max), fits, 0.0)


def _range(camera: RefractiveCamera, points: Float[Tensor, "k 3"]) -> tuple[float, float]:
    pixels, _ = camera.project(points)
    distance = PixelRays.cast(camera, pixels).distance_of(points)
    low, high = float(distance.quantile(0.01)), float(distance.quantile(0.99))
    margin = MARGIN * max(high - low, 0.05 * abs(high))
    return low - margin, high + margin
