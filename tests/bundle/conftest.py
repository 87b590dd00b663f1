"""Planted scenes: cameras, points, lenses and water, and what the cameras see of the points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from torchrefrac.bundle import (
    BundleOptions,
    BundleProblem,
    BundleReport,
    BundleState,
    GravityPrior,
    Links,
    Observations,
    Term,
    adjust,
)
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.terms import concerned_points
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import so3_exp
from torchrefrac.optim import LevenbergMarquardtOptions

SQUARED = BundleOptions(loss="squared", solver=LevenbergMarquardtOptions(max_iterations=100, function_tolerance=1e-12))


@dataclass(frozen=True)
class Planted:
    """The true state, which lens and water each image has, the observations (sorted by point), the true gravity."""

    truth: BundleState
    links: Links
    observations: Observations
    down_in_cam: Tensor

    @property
    def gravity(self) -> GravityPrior:
        """Known to 0.01 radians."""
        return GravityPrior(self.down_in_cam, 0.01)

    def layout(self, refine=(), *, terms: Sequence[Term] = (), held: Tensor | None = None) -> Layout:
        kept = concerned_points(terms, len(self.truth.points), self.truth.points)
        return Layout.create(self.truth, self.links, tuple(refine), held, kept=kept)

    def problem(self, *, terms: Sequence[Term] = (), held: Tensor | None = None, **changes) -> BundleProblem:
        """The problem of adjusting the truth, by default with the loss squared; changes: of the options."""
        options = replace(SQUARED, **changes)
        layout = self.layout(options.refine, terms=terms, held=held)
        return BundleProblem.create(self.truth, layout, self.observations, options, terms)

    def adjusted(
        self, start: BundleState, *, terms: Sequence[Term] = (), held=None, check=True, callback=None, **changes
    ) -> BundleReport:
        """`adjust` from `start`, with the loss squared; changes: of the options."""
        options = replace(SQUARED, **changes)
        rest = {"terms": terms, "held": held, "check": check, "callback": callback}
        return adjust(start, self.observations, options, links=self.links, **rest)

    def with_wrong_observations(self, draw) -> "Planted":
        """Every twentieth pixel is off by up to 30."""
        pixels = self.observations.pixels.clone()
        pixels[::20] += draw.uniform(-30.0, 30.0, len(pixels[::20]), 2)
        return replace(self, observations=replace(self.observations, pixels=pixels))

    def without(self, rows: Tensor) -> "Planted":
        """The same without some of its observations (a mask)."""
        return replace(self, observations=self.observations[~rows])


@pytest.fixture
def squared() -> BundleOptions:
    """Converged as far as float64 goes, and without a robust loss: what least squares by other means compares with."""
    return SQUARED


@pytest.fixture
def plant(make_basin, draw) -> Callable[..., Planted]:
    """`plant(cameras=4, points=30, noise=0.0, ...)`: points that two or more cameras see, noise in pixels.

    lenses: as many different ones, in turn; planes: as many different waters, for half of the cameras each, the later
    ones tilted and higher by some centimetres. The rest goes to `make_basin`.
    """

    def make(cameras=4, points=30, noise=0.0, lenses=1, planes=1, **scene) -> Planted:
        basin = make_basin(cameras=cameras, points=points, seen_by=min(2, cameras), **scene)
        point, camera = basin.project()[1].T.nonzero(as_tuple=True)
        turn = torch.arange(cameras)
        truth = BundleState(
            basin.rotation,
            basin.center,
            basin.points,
            _lenses(basin.lens, lenses),
            torch.tensor(basin.index_ratio, dtype=torch.float64),
            *_planes(planes),
        )
        links = Links(turn % lenses, (turn * planes) // cameras)
        exact, valid = truth.cameras(links, camera).project(truth.points[point])
        assert valid.all()
        pixels = exact + noise * draw.normal(len(camera), 2)
        return Planted(truth, links, Observations(camera, point, pixels), basin.down_in_cam)

    return make


def _lenses(lens: Intrinsics, count: int) -> Intrinsics:
    if count == 1:
        return lens
    step = torch.arange(count, dtype=torch.float64)[:, None]
    return replace(
        lens,
        focal=lens.focal * (1.0 + step * torch.tensor((0.06, 0.05), dtype=torch.float64)),
        principal_point=lens.principal_point + step * torch.tensor((5.0, -7.0), dtype=torch.float64),
        distortion=lens.distortion + step * torch.tensor((-0.02, 0.01, 1e-3, -1e-3, 2e-3), dtype=torch.float64),
    )


def _planes(count: int) -> tuple[Tensor, Tensor]:
    step = torch.arange(count, dtype=torch.float64)
    normal = torch.stack((0.02 * step, -0.03 * step, torch.ones_like(step)), dim=-1)
    return torch.nn.functional.normalize(normal, dim=-1), 2.0 * step


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
