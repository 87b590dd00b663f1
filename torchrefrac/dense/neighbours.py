"""Which images to compare with which, and between which distances to look, as the sparse points tell."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.view_angle import angle_between, fitness
from torchrefrac.scene import Reconstruction

MARGIN = 0.25  # of the range of distances of the sparse points, added at either end
MIN_POINTS = 5


class Neighbourhood(NamedTuple):
    """of an image: others (n) best first; near, far: distances along its rays (see `PixelRays`)."""

    others: Tensor
    near: float
    far: float


def find_neighbours(reconstruction: Reconstruction, options: DenseOptions) -> dict[int, Neighbourhood]:
    """Of every registered image that shares points with another one seen at a useful angle.

    An image's worth to another is the sum over common points of how near the angle between their rays is to the best.
    """
    shared = _visibility(reconstruction)
    found = {}
    for image in reconstruction.registered.nonzero()[:, 0].tolist():
        points = shared[:, image].nonzero()[:, 0]
        if len(points) < MIN_POINTS:
            continue
        worth = _worth(reconstruction, image, points, shared, options)
        order = worth.argsort(descending=True, stable=True)[: options.neighbours]
        order = order[worth[order] > 0.0]
        if len(order):
            found[image] = Neighbourhood(order, *_range(reconstruction, image, reconstruction.points[points]))
    return found


def _visibility(reconstruction: Reconstruction) -> Tensor:
    """(n, m) which points are observed in which images."""
    seen = torch.zeros(len(reconstruction.points), len(reconstruction.names), dtype=torch.bool)
    seen[reconstruction.point, reconstruction.image] = True
    return seen


def _worth(reconstruction: Reconstruction, image: int, points: Tensor, shared: Tensor, options: DenseOptions) -> Tensor:
    """Of all images (m) to `image`."""
    angle = angle_between(reconstruction.center[:, None], reconstruction.center[image], reconstruction.points[points])
    fits = torch.where(shared[points].T, fitness(angle, options), 0.0)
    fits[image] = 0.0
    return fits.sum(dim=1) * reconstruction.registered


def _range(reconstruction: Reconstruction, image: int, points: Tensor) -> tuple[float, float]:
    camera = reconstruction.cameras[image]
    pixels, _ = camera.project(points)
    distance = PixelRays.cast(camera, pixels).distance_of(points)
    low, high = float(distance.quantile(0.01)), float(distance.quantile(0.99))
    margin = MARGIN * max(high - low, 0.05 * abs(high))
    return low - margin, high + margin
