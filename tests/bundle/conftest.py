"""Planted scenes: views, points, cameras and water, and what the views see of the points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from tests.bundle.changes import changed
from torchrefrac.bundle import BundleOptions, BundleProblem, BundleReport, GravityPrior, Term, adjust
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.terms import concerned_points
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid, so3_exp
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.scene import Interfaces, Observations, Scene

SQUARED = BundleOptions(loss="squared", solver=LevenbergMarquardtOptions(max_iterations=100, function_tolerance=1e-12))


@dataclass(frozen=True)
class Planted:
    """The true scene, the observations (sorted by point), the true gravity."""

    truth: Scene
    observations: Observations
    down_in_cam: Tensor

    @property
    def gravity(self) -> GravityPrior:
        """Known to 0.01 radians."""
        return GravityPrior(self.down_in_cam, 0.01)

    def seen_in(self, scene: Scene) -> Scene:
        """A scene with these observations."""
        same = scene.observations is self.observations
        return scene if same else changed(scene, observations=self.observations)

    def layout(self, refine=(), *, terms: Sequence[Term] = (), fixed: Tensor | None = None) -> Layout:
        return Layout.create(self.truth, tuple(refine), fixed, reduced=concerned_points(terms, self.truth.points))

    def problem(self, *, terms: Sequence[Term] = (), fixed: Tensor | None = None, **changes) -> BundleProblem:
        """The problem of adjusting the truth, by default with the loss squared; changes: of the options."""
        options = replace(SQUARED, **changes)
        layout = self.layout(options.refine, terms=terms, fixed=fixed)
        return BundleProblem.create(self.seen_in(self.truth), layout, options, terms)

    def adjusted(
        self, start: Scene, *, terms: Sequence[Term] = (), fixed=None, check=True, callback=None, **changes
    ) -> BundleReport:
        """`adjust` from `start`, with the loss squared; changes: of the options."""
        options = replace(SQUARED, **changes)
        return adjust(self.seen_in(start), options, terms=terms, fixed=fixed, check=check, callback=callback)

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
    """`plant(views=4, points=30, noise=0.0, ...)`: points that two or more views see, noise in pixels.

    cameras: as many different ones, in turn; interfaces: as many different waters, for half of the views each, the
    later ones tilted and higher by some centimetres; glass: of this thickness before the water, the last interface
    without any where there are several. The rest goes to `make_basin`.
    """

    def make(views=4, points=30, noise=0.0, cameras=1, interfaces=1, glass=None, **scene) -> Planted:
        basin = make_basin(cameras=views, points=points, seen_by=min(2, views), **scene)
        point, view = basin.project()[1].T.nonzero(as_tuple=True)
        turn = torch.arange(views)
        truth = Scene.create(
            Rigid(basin.rotation, basin.center),
            _cameras(basin.lens, cameras),
            _interfaces(interfaces, basin.index_ratio, glass),
            basin.points,
            Observations(view, point, torch.zeros(len(view), 2, dtype=torch.float64)),
            camera=turn % cameras,
            interface=(turn * interfaces) // views,
        )
        exact, valid = truth.camera_of(view).project(truth.points[point])
        assert valid.all()
        seen = replace(truth.observations, pixels=exact + noise * draw.normal(len(view), 2))
        return Planted(replace(truth, observations=seen), seen, basin.down_in_cam)

    return make


def _cameras(first: Intrinsics, count: int) -> list[Intrinsics]:
    change = first.distortion.new_tensor((-0.02, 0.01, 1e-3, -1e-3, 2e-3))
    return [
        replace(
            first,
            focal=first.focal * (1.0 + step * first.focal.new_tensor((0.06, 0.05))),
            principal_point=first.principal_point + step * first.focal.new_tensor((5.0, -7.0)),
            distortion=first.distortion + step * change,
        )
        for step in range(count)
    ]


def _interfaces(count: int, index_ratio: float, glass: float | None) -> Interfaces:
    step = torch.arange(count, dtype=torch.float64)
    normal = torch.stack((0.02 * step, -0.03 * step, torch.ones_like(step)), dim=-1)
    level = Interfaces(torch.nn.functional.normalize(normal, dim=-1), 2.0 * step, torch.full_like(step, index_ratio))
    if glass is None:
        return level
    thickness = glass * (step < max(count - 1, 1)).double()[:, None]
    return replace(level, layers=torch.full_like(thickness, 1.52), thickness=thickness)


@pytest.fixture
def disturb(draw) -> Callable[..., Scene]:
    """`disturb(scene)`: views turned by about half a degree and moved by half a centimetre, points by one."""

    def move(scene: Scene, size: float = 1.0) -> Scene:
        m, n = len(scene.views), len(scene.points)
        return changed(
            scene,
            rotation=so3_exp(0.01 * size * draw.normal(m, 3)) @ scene.views.rotation,
            center=scene.views.center + 0.5 * size * draw.normal(m, 3),
            points=scene.points + size * draw.normal(n, 3),
        )

    return move
