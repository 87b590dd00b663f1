"""The pose of one camera at the least reprojection error of known points."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from tests.tolerances import assert_matches
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import level_rotation, rotate, so3_exp
from torchrefrac.refinement import OneView, tilt_and_heading
from torchrefrac.refraction import FlatInterface

PIXEL_SIGMA, GRAVITY_SIGMA = 0.5, math.radians(1.0)
MAX_ERROR = 4.0


@dataclass(frozen=True)
class Planted:
    """basin: the truth; view: what was measured of it; truth (6) in the terms of `view`; pixels (N, 2)."""

    basin: Any
    view: OneView
    truth: Tensor
    pixels: Tensor

    def start(self, draw, size: float = 1.0) -> Tensor:
        """A model (1, 6) about a degree and a centimetre from the truth."""
        scale = torch.tensor([0.02] * 3 + [1.0] * 3, dtype=torch.float64)
        return (self.truth + size * scale * draw.normal(6))[None]

    def refined(self, start: Tensor | None = None, max_error: float = MAX_ERROR, tolerance: float = 1e-8) -> Tensor:
        """The state (6) that the refinement ends at, from the truth unless told otherwise."""
        models = self.truth[None] if start is None else start
        return self.view.refine(models, max_error, 30, tolerance).states[0]

    def covariance(self) -> Tensor:
        """The Cramér-Rao bound (6, 6): from the quadratic model at the truth."""
        return PIXEL_SIGMA**2 * torch.linalg.inv(self.view.linearize(self.truth[None], 1e9).hessian[0])

    def residuals(self, model: Tensor) -> Tensor:
        """Reprojection errors (N, 2) by the camera of the package."""
        rotation, center = self.view.poses(model[None])
        camera = RefractiveCamera(self.basin.lens, rotation[0], center[0], FlatInterface(self.basin.index_ratio))
        return camera.project(self.view.points)[0] - self.pixels


@pytest.fixture
def make_planted(make_basin, draw) -> Callable[..., Planted]:
    """`make_planted(points=40, land=10, noise=0.0, gravity_error=0.0, basin=None, ...)`: pixels and a vertical with
    errors of that many pixels and radians; the rest goes to `OneView`. A basin given is measured once more."""

    def make(
        points: int = 40,
        land: int = 10,
        noise: float = 0.0,
        gravity_error: float = 0.0,
        index_ratio: float = 1.33,
        basin=None,
        **options,
    ) -> Planted:
        basin = make_basin(cameras=1, points=points, land=land, index_ratio=index_ratio) if basin is None else basin
        exact = basin.project()[0][0]
        pixels = exact + noise * draw.normal(*exact.shape)
        turn = so3_exp(gravity_error * draw.normal(3))
        level = level_rotation(rotate(turn, basin.down_in_cam[0]))
        tilt, heading = tilt_and_heading(level, basin.rotation[0])
        options = {"gravity_sigma": GRAVITY_SIGMA, "pixel_sigma": PIXEL_SIGMA, **options}
        index = torch.tensor(basin.index_ratio, dtype=torch.float64)
        view = OneView(basin.lens.plane_from_pixels(pixels), basin.points, level, basin.lens.focal, index, **options)
        return Planted(basin, view, torch.cat((tilt, heading[None], basin.center[0])), pixels)

    return make


lands = pytest.mark.parametrize("land", [0, 10, 40], ids=["wet", "both", "dry"])


@lands
def test_squared_errors_are_those_of_the_camera(make_planted, draw, land):
    planted = make_planted(land=land, noise=PIXEL_SIGMA)
    models = torch.cat([planted.start(draw, size=0.5) for _ in range(7)])

    squares = planted.view.squared_errors(models)

    expected = torch.stack([planted.residuals(model).square().sum(dim=-1) for model in models])
    torch.testing.assert_close(squares, expected, rtol=1e-5, atol=1e-5)


def test_points_behind_the_camera_and_cameras_below_the_water_have_infinite_errors(make_planted):
    planted = make_planted(land=0)
    away, below = planted.truth.clone(), planted.truth.clone()
    away[:2] = torch.tensor((math.pi, 0.0))
    below[5] = -1.0

    squares = planted.view.squared_errors(torch.stack((planted.truth, away, below)))

    assert squares[0].max() < 1e-9
    rotation, center = planted.view.poses(torch.stack((away, below)))
    ahead = (planted.view.points - center[0]) @ rotation[0, 2] > 0.0
    assert squares[1].isinf()[~ahead].any()
    assert squares[2].isinf().all()
    assert not squares.isnan().any()


@lands
@pytest.mark.parametrize("index_ratio", [1.0, 1.33])
@pytest.mark.parametrize("gravity_sigma", [0.0, GRAVITY_SIGMA, math.inf])
def test_without_noise_the_truth_is_found_from_beside_it(make_planted, draw, gravity_sigma, index_ratio, land):
    planted = make_planted(gravity_sigma=gravity_sigma, land=land, index_ratio=index_ratio)
    start = planted.start(draw)
    if gravity_sigma == 0.0:
        start[:, :2] = 0.0

    found = planted.refined(start, max_error=300.0)

    torch.testing.assert_close(found, planted.truth, rtol=0.0, atol=1e-7)


@lands
@pytest.mark.parametrize("size", [0.0, 0.3])
def test_gradient_and_hessian_are_those_of_the_residuals_by_autograd(make_planted, draw, size, land):
    planted = make_planted(land=land, noise=PIXEL_SIGMA, gravity_sigma=math.inf)
    model = planted.start(draw, size)[0]

    quadratic = planted.view.linearize(model[None], 1e9)

    residual = planted.residuals(model).flatten()
    jacobian = torch.autograd.functional.jacobian(lambda x: planted.residuals(x).flatten(), model)
    torch.testing.assert_close(quadratic.cost[0], 0.5 * residual.square().sum(), rtol=1e-9, atol=0.0)
    size_of = jacobian.norm(dim=0)
    torch.testing.assert_close(quadratic.gradient[0] / size_of, jacobian.mT @ residual / size_of, rtol=1e-8, atol=1e-8)
    units = size_of[:, None] * size_of
    torch.testing.assert_close(quadratic.hessian[0] / units, jacobian.mT @ jacobian / units, rtol=0.0, atol=1e-9)


def test_the_gradient_is_that_of_the_cost_with_the_prior_in_it(make_planted, draw):
    planted = make_planted(noise=PIXEL_SIGMA)
    model = planted.start(draw)[0]

    def cost(x: Tensor) -> Tensor:
        prior = (PIXEL_SIGMA / GRAVITY_SIGMA) ** 2 * x[:2].square().sum()
        return 0.5 * (planted.residuals(x).square().sum() + prior)

    quadratic = planted.view.linearize(model[None], 1e9)
    gradient = torch.autograd.functional.jacobian(cost, model)
    torch.testing.assert_close(quadratic.gradient[0], gradient, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(quadratic.cost[0], cost(model), rtol=1e-9, atol=0.0)


@lands
def test_the_pose_is_that_of_scipy(make_planted, draw, land):
    planted = make_planted(land=land, noise=PIXEL_SIGMA, gravity_error=GRAVITY_SIGMA)

    found = planted.refined(planted.start(draw, 0.3), max_error=1e3, tolerance=1e-14)

    weight = PIXEL_SIGMA / GRAVITY_SIGMA

    def residual(x):
        model = torch.from_numpy(x)
        return torch.cat((planted.residuals(model).flatten(), weight * model[:2])).numpy()

    oracle = least_squares(residual, planted.truth.numpy(), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    deviation = planted.covariance().diagonal().sqrt()
    assert ((found - torch.from_numpy(oracle)).abs() < 1e-4 * deviation).all()


def test_the_error_is_no_larger_than_the_cramer_rao_bound_and_has_no_bias(make_planted):
    """Of 60 draws of the pixels and of the vertical."""
    first = make_planted(points=60)
    deviation = first.covariance().diagonal().sqrt()

    errors = []
    for _ in range(60):
        planted = make_planted(noise=PIXEL_SIGMA, gravity_error=GRAVITY_SIGMA, basin=first.basin)
        errors.append((planted.refined() - planted.truth) / deviation)
    errors = torch.stack(errors)

    rms = errors.square().mean(dim=0).sqrt()
    assert rms.max() < 1.2
    assert rms.min() > 0.7  # else the bound would not be one
    assert (errors.mean(dim=0).abs() < 4.0 * errors.std(dim=0) / math.sqrt(60)).all()


@pytest.mark.parametrize("gravity_sigma", [math.radians(2.0), math.inf])
def test_two_degrees_of_error_of_the_vertical_are_absorbed(make_planted, gravity_sigma):
    planted = make_planted(points=60, noise=PIXEL_SIGMA, gravity_error=math.radians(2.0), gravity_sigma=gravity_sigma)
    start = planted.truth.clone()
    start[:2] = 0.0
    assert planted.truth[:2].norm() > math.radians(0.5)

    found = planted.refined(start[None], max_error=100.0)

    assert (found - planted.truth)[:3].abs().max() < math.radians(0.3)
    assert (found - planted.truth)[3:].norm() < 0.5
    held = replace(planted, view=replace(planted.view, gravity_sigma=0.0)).refined(start[None], max_error=100.0)
    assert (held - planted.truth)[3:].norm() > 3.0 * (found - planted.truth)[3:].norm()


def test_an_exact_vertical_is_held(make_planted):
    planted = make_planted(noise=PIXEL_SIGMA, gravity_sigma=0.0)

    error = planted.refined() - planted.truth

    assert torch.equal(error[:2], torch.zeros(2, dtype=torch.float64))
    assert (error[2:].abs() < 3.5 * planted.covariance().diagonal()[2:].sqrt()).all()


@pytest.mark.parametrize("gravity_sigma", [0.0, GRAVITY_SIGMA])
def test_a_known_heading_is_held(make_planted, gravity_sigma):
    planted = make_planted(noise=PIXEL_SIGMA, gravity_sigma=gravity_sigma, known_heading=0.5)
    start = planted.truth.clone()
    start[:2] = 0.0

    found = planted.refined(start[None], max_error=40.0)

    assert found[2] == start[2]
    assert (found[3:] != start[3:]).all()
    assert bool((found[:2] != 0.0).any()) == (gravity_sigma > 0.0)


def test_a_camera_never_ends_below_the_water(make_planted, draw):
    """Points at random pixels pull it anywhere."""
    planted = make_planted(land=0)
    view = replace(planted.view, plane=0.5 * draw.normal(40, 2))
    models = planted.truth.repeat(30, 1)
    models[:, 3:] += draw.uniform(-20.0, 20.0, 30, 3)
    models[:, 5] = draw.power_of_ten(-3.0, 1.0, 30)

    report = view.refine(models, 1e4, 30)

    assert (report.states[:, 5] > 0.0).all()
    assert report.states.isfinite().all()
    assert view.linearize(planted.truth[None] - 100.0, MAX_ERROR).cost.isinf().all()


def test_outliers_do_not_move_the_pose(make_planted, draw):
    """Against the bound of the right ones of 100 points."""
    first = make_planted(points=100, land=20)
    right = replace(first, view=first.view.rows(torch.arange(70)))
    deviation = right.covariance().diagonal().sqrt()

    errors = []
    for _ in range(30):
        planted = make_planted(noise=PIXEL_SIGMA, gravity_error=GRAVITY_SIGMA, basin=first.basin)
        plane = planted.view.plane.clone()
        plane[70:] += 0.2 * draw.normal(30, 2)
        spoilt = replace(planted, view=replace(planted.view, plane=plane))
        errors.append((spoilt.refined() - planted.truth) / deviation)

    assert torch.stack(errors).square().mean(dim=0).sqrt().max() < 1.5


def test_points_beyond_max_error_or_behind_the_camera_do_not_count(make_planted):
    planted = make_planted(noise=0.3, gravity_sigma=math.inf)
    plane, points = planted.view.plane.clone(), planted.view.points.clone()
    plane[:5] += 0.1
    points[5:8] = planted.basin.center[0] - 50.0 * planted.basin.rotation[0, 2]
    view = replace(planted.view, plane=plane, points=points)

    truncated, alone = (v.linearize(planted.truth[None], MAX_ERROR) for v in (view, view.rows(torch.arange(8, 40))))

    assert_matches(truncated.cost, alone.cost + 0.5 * MAX_ERROR**2 * 8, slack=100.0)
    assert_matches(truncated.gradient, alone.gradient, slack=1e3)
    assert_matches(truncated.hessian, alone.hessian, slack=100.0)


def test_many_models_are_refined_each_by_itself(make_planted, draw):
    planted = make_planted(noise=PIXEL_SIGMA)
    starts = torch.cat([planted.start(draw, size=0.5) for _ in range(6)])

    together = planted.view.refine(starts, 60.0, 30)

    assert together.converged.all()
    for k, start in enumerate(starts):
        alone = planted.view.refine(start[None], 60.0, 30)
        torch.testing.assert_close(together.states[k], alone.states[0], rtol=1e-6, atol=1e-6)


def test_rows_are_some_of_the_points(make_planted):
    view, rows = make_planted().view, torch.tensor((7, 3, 30))

    some = view.rows(rows)

    assert len(view) == 40
    assert len(some) == 3
    assert torch.equal(some.plane, view.plane[rows])
    assert torch.equal(some.points, view.points[rows])
    assert some.cam_from_level is view.cam_from_level


def test_single_precision_gives_the_same_errors_to_a_hundredth_of_a_pixel(make_planted, draw):
    planted = make_planted(noise=PIXEL_SIGMA)
    model = planted.start(draw, size=0.1)

    single = planted.view.single().squared_errors(model.float())

    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double().sqrt(), planted.view.squared_errors(model).sqrt(), rtol=0.0, atol=0.01)
