"""Random stacks of layers with a camera before them and a point behind or inside, and slow exact solutions of them."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import brentq
from torch import Tensor

from torchrefrac.refraction import FlatInterface, lift_points

EXTENDED = np.longdouble


@dataclass(frozen=True)
class Stack:
    """n sightings through k + 1 media, the first surface at z = 0, the camera on the z axis, the point at y = 0.

    index (k + 1, n), thickness (k - 1, n) of the inner layers; height of the camera and depth of the point on either
    side of the first surface, and their distance from each other along it, each (n).
    """

    index: Tensor
    thickness: Tensor
    height: Tensor
    depth: Tensor
    distance: Tensor

    @property
    def interface(self) -> FlatInterface:
        return FlatInterface(layers=tuple(self.index), thickness=tuple(self.thickness))

    @property
    def center(self) -> Tensor:
        zero = torch.zeros_like(self.height)
        return torch.stack((zero, zero, self.height), dim=-1)

    @property
    def point(self) -> Tensor:
        return torch.stack((self.distance, torch.zeros_like(self.distance), -self.depth), dim=-1)

    @property
    def apparent_height(self) -> Tensor:
        """That of `lift_points`, every sighting being valid."""
        offset, valid = lift_points(self.center, self.point, self.interface)
        assert valid.all()
        return -offset[:, 2]

    @property
    def crossed(self) -> np.ndarray:
        """Way through each medium along the vertical (k + 1, n), in extended precision."""
        ways, rest = [_extended(self.height)], _extended(self.depth)
        for d in _extended(self.thickness):
            ways.append(np.clip(rest, 0.0, d))
            rest = rest - d
        return np.stack((*ways, np.maximum(rest, 0.0)))

    def worst_error(self) -> float:
        """Of `apparent_height`, relative to the root of the very same numbers in extended precision."""
        exact = solve_in_extended_precision(self.crossed, _extended(self.index), _extended(self.distance))
        return float((np.abs(_extended(self.apparent_height) - exact) / exact).max())

    def to(self, dtype: torch.dtype) -> "Stack":
        values = (self.index, self.thickness, self.height, self.depth, self.distance)
        return Stack(*(value.to(dtype) for value in values))


def make_stack(draw, index: Tensor, *, decades=3.0, max_deg=89.9, thin=False) -> Stack:
    """Sightings through media of `index` (k + 1, n): the point lies in any layer but the camera's, not on its surface.

    Ways through the layers are within `decades` of the camera's height; of those that lie before the point's layer or
    behind it one in ten has no thickness. The angle in the rarest medium on the way is spread evenly, or its tangent
    is on a logarithmic scale, up to `max_deg`. thin: the rarest inner layer is a million times thinner.
    """
    media, count = index.shape
    height = draw.power_of_ten(-2.0, 2.0, count)
    ways = height * draw.power_of_ten(-decades, decades, media - 1, count)
    if thin:
        rarest = index[1:-1].argmin(dim=0, keepdim=True)
        ways[:-1].scatter_(0, rarest, 1e-6 * ways[:-1].gather(0, rarest))
    layer, last = torch.arange(media - 1)[:, None], draw.uniform(0.0, media - 1.0, count).long()
    ways = torch.where((layer != last) & (draw.uniform(0.0, 1.0, media - 1, count) < 0.1), 0.0, ways)
    part = torch.where(layer == last, draw.uniform(0.01, 0.99, count), (layer < last).double())
    crossed = ways * part
    by_angle = torch.deg2rad(draw.uniform(0.01, max_deg, count)).tan()
    by_tangent = draw.power_of_ten(-3.0, math.log10(math.tan(math.radians(max_deg))), count)
    tangent = torch.where(draw.uniform(0.0, 1.0, count) < 0.5, by_angle, by_tangent)
    crossed = torch.cat((height[None], crossed))
    sideways = horizontal_ways(crossed.numpy(), index.numpy(), tangent.numpy())
    return Stack(index, ways[:-1], height, crossed[1:].sum(dim=0), torch.from_numpy(sideways.sum(axis=0)))


def horizontal_ways(crossed: np.ndarray, index: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Horizontal way in each medium of a ray at that angle in the rarest one that it crosses."""
    used = crossed > 0.0
    rarest = np.where(used, index, np.inf).min(axis=0)
    excess = np.where(used, (index - rarest) * (index + rarest) / rarest**2, 0.0)
    return crossed * tangent / np.sqrt((index / rarest) ** 2 + excess * tangent**2)


def solve_in_extended_precision(crossed: np.ndarray, index: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Apparent height (n): the tangent in the rarest medium bisected on a logarithmic scale, then Newton."""
    used = crossed > 0.0
    rarest = np.where(used, index, np.inf).min(axis=0)
    index = np.where(used, index, rarest)
    excess = (index - rarest) * (index + rarest) / rarest**2 * distance**2
    index_sq = (index / rarest) ** 2

    def miss(s):
        return s * (crossed / np.sqrt(index_sq + excess * s * s)).sum(axis=0) - 1.0

    low = 1.0 / (crossed * rarest / index).sum(axis=0)
    high = 1.0 / np.where(index == rarest, crossed, 0.0).sum(axis=0)
    for _ in range(50):
        middle = np.sqrt(low * high)
        below = miss(middle) < 0.0
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    s = np.sqrt(low * high)
    for _ in range(4):
        s = s - miss(s) / (crossed * index_sq * (index_sq + excess * s * s) ** -1.5).sum(axis=0)
    return np.sqrt(index_sq[0] / s**2 + excess[0])


def solve_by_bracketing(crossed: list[float], index: list[float], distance: float) -> float:
    """Apparent height of one sighting, in plain Python: the tangent in the rarest medium between nadir and level."""
    layers = [(d, n) for d, n in zip(crossed, index, strict=True) if d > 0.0]
    rarest = min(n for _, n in layers)

    def way(d, n, tangent):
        return d * tangent / math.sqrt((n / rarest) ** 2 + (n - rarest) * (n + rarest) * (tangent / rarest) ** 2)

    def excess(tangent):
        return math.fsum((*(way(d, n, tangent) for d, n in layers), -distance))

    clear = math.fsum(d for d, n in layers if n == rarest)
    tangent = brentq(excess, 0.0, 1.000001 * distance / clear, xtol=1e-300, rtol=1e-15, maxiter=1000)
    return crossed[0] * distance / way(crossed[0], index[0], tangent)


def _extended(value: Tensor) -> np.ndarray:
    return value.numpy().astype(EXTENDED)
