"""A made flight over a river: views in parallel lines along it, each point seen by about seven neighbouring ones.

Ten lines 6 m apart, 10 m above the water, a view every 3 m, 3000 px of focal length; a photograph shows 14 m along the
river by 9 m across it. Points lie 0.3 to 2 m deep. Positions are measured to 2 cm, pixels to 0.5. The start is off by
0.2 degrees, 5 cm and 1 % of the focal length; points are off by 10 cm.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefrac.bundle import CenterPrior
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid, so3_exp
from torchrefrac.scene import Interfaces, Observations, Scene

LINES = 10
APART, BETWEEN, HEIGHT = 3.0, 6.0, 10.0
HALF_ALONG, HALF_ACROSS = 7.0, 4.5
FOCAL, INDEX_RATIO = 3000.0, 1.333
PIXEL_SIGMA, POSITION_SIGMA = 0.5, 0.02
OFF_DEG, OFF_CENTER, OFF_POINT, OFF_FOCAL = 0.2, 0.05, 0.1, 0.01
AT_ONCE = 100_000


@dataclass(frozen=True)
class Flight:
    """start: the scene that is adjusted, with the observations. positions: those of its views, as measured."""

    start: Scene
    positions: CenterPrior


def make_flight(views: int, points: int, seed: int = 0) -> Flight:
    """So many views, a multiple of LINES, and points; observations in the order of the points."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    line, step = torch.arange(LINES).repeat_interleave(views // LINES), torch.arange(views // LINES).repeat(LINES)
    grid = torch.stack((APART * step.double(), BETWEEN * line.double(), torch.full((views,), HEIGHT).double()), dim=1)
    center = grid + 0.2 * normal(views, 3)
    down = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64))
    rotation = so3_exp(math.radians(3.0) * normal(views, 3)) @ down
    uniform = torch.rand(points, 3, generator=generator, dtype=torch.float64)
    low, high = uniform.new_tensor((0.0, 0.0, -2.0)), torch.cat((grid.amax(dim=0)[:2], uniform.new_tensor((-0.3,))))
    bed = low + (high - low) * uniform
    parts = [_seen(center, bed[first : first + AT_ONCE], first) for first in range(0, points, AT_ONCE)]
    view, point = (torch.cat(ids) for ids in zip(*parts, strict=True))
    _, counted, count = torch.unique_consecutive(point, return_inverse=True, return_counts=True)
    often = (count >= 2)[counted]
    kept, point = torch.unique_consecutive(point[often], return_inverse=True)
    view, bed = view[often], bed[kept]
    lens = Intrinsics.create(4000, 3000, FOCAL, (2000.0, 1500.0))
    truth = Scene.create(
        Rigid(rotation, center),
        lens,
        Interfaces.level(INDEX_RATIO),
        bed,
        Observations(view, point, torch.zeros(len(view), 2, dtype=torch.float64)),
    )
    seen = truth.observations
    for first in range(0, len(seen), AT_ONCE):
        here = slice(first, first + AT_ONCE)
        exact, _ = truth.cameras_of(seen[here]).project(bed[point[here]])
        seen.pixels[here] = exact + PIXEL_SIGMA * normal(*exact.shape)
    start = Scene.create(
        Rigid(so3_exp(math.radians(OFF_DEG) * normal(views, 3)) @ rotation, center + OFF_CENTER * normal(views, 3)),
        Intrinsics.create(4000, 3000, FOCAL * (1.0 + OFF_FOCAL), (2000.0, 1500.0)),
        truth.interfaces,
        (bed + OFF_POINT * normal(*bed.shape)).minimum(bed.new_tensor((torch.inf, torch.inf, -0.05))),
        seen,
    )
    information = (torch.eye(3, dtype=torch.float64) / POSITION_SIGMA**2).expand(views, 3, 3)
    return Flight(start, CenterPrior(torch.arange(views), center + POSITION_SIGMA * normal(views, 3), information))


def _seen(center: Tensor, bed: Tensor, first: int) -> tuple[Tensor, Tensor]:
    """Which views show which of the points `bed`, that are numbered from `first` on."""
    steps = len(center) // LINES
    beside = torch.cartesian_prod(torch.arange(-1, 2), torch.arange(-3, 4))
    near = torch.stack((bed[:, 1] / BETWEEN, bed[:, 0] / APART), dim=1).round().long()[:, None] + beside
    inside = (near >= 0).all(dim=-1) & (near[..., 0] < LINES) & (near[..., 1] < steps)
    view = (near[..., 0] * steps + near[..., 1]).clamp(0, len(center) - 1)
    off = (center[view] - bed[:, None])[..., :2].abs()
    inside &= (off[..., 0] <= HALF_ALONG) & (off[..., 1] <= HALF_ACROSS)
    point, which = inside.nonzero(as_tuple=True)
    return view[point, which], point + first
