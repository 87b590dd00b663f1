"""Planted scenes: cameras, points, and what the cameras see of the points."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from torchrefrac.bundle import BundleProblem, BundleState, GravityPrior
from torchrefrac.geometry import so3_exp
from torchrefrac.optim import SchurPlan


@dataclass(frozen=True)
class Planted:
    """The true state, the observations (sorted by point) and the true gravity."""

    truth: BundleState
    camera: Tensor
    point: Tensor
    pixels: Tensor
    index_ratio: Tensor
    down_in_cam: Tensor

    @property
    def observations(self) -> dict[str, Tensor]:
        return {
            "camera": self.camera,
            "point": self.point,
            "pixels": self.pixels,
            "index_ratio": self.index_ratio,
        }

    def problem(self, *, loss_scale=1e9, gravity=False, refine_radial=False, free_gauge=False) -> BundleProblem:
        """The cost of the observations; gravity is known to 0.01 radians, pixels to 0.3."""
        shared = 2 if refine_radial else 0
        return BundleProblem(
            plan=SchurPlan.create(self.camera, self.point, len(self.truth.center), len(self.truth.points), shared),
            pixels=self.pixels,
            index_ratio=self.index_ratio,
            loss_scale=loss_scale,
            pixel_sigma=0.3,
            gravity=GravityPrior(self.down_in_cam, 0.01) if gravity else None,
            free_gauge=free_gauge,
        )


@pytest.fixture
def plant(make_basin, draw) -> Callable[..., Planted]:
    """`plant(cameras=4, points=30, noise=0.0, ...)`: points that two or more cameras see, noise in pixels."""

    def make(cameras=4, points=30, noise=0.0, **scene) -> Planted:
        basin = make_basin(cameras=cameras, points=points, seen_by=min(2, cameras), **scene)
        pixels, seen = basin.project()
        point, camera = seen.T.nonzero(as_tuple=True)
        return Planted(
            truth=BundleState(basin.rotation, basin.center, basin.points, basin.lens),
            camera=camera,
            point=point,
            pixels=pixels[camera, point] + noise * draw.normal(len(camera), 2),
            index_ratio=torch.tensor(basin.index_ratio, dtype=torch.float64),
            down_in_cam=basin.down_in_cam,
        )

    return make


@pytest.fixture
def disturb(draw) -> Callable[[BundleState], BundleState]:
    """`disturb(state)`: cameras turned by about half a degree and moved by half a centimetre, points by one."""

    def move(state: BundleState, size: float = 1.0) -> BundleState:
        m, n = len(state.center), len(state.points)
        return replace(
            state,
            rotation=so3_exp(0.01 * size * draw.normal(m, 3)) @ state.rotation,
            center=state.center + 0.5 * size * draw.normal(m, 3),
            points=state.points + size * draw.normal(n, 3),
        )

    return move
