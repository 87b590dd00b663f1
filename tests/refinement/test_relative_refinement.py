"""The relative pose of two cameras at the least epipolar error."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.tolerances import assert_matches
from torchrefrac.bundle import BundleOptions, GravityPrior, adjust
from torchrefrac.geometry import Rigid, heading_rotation, level_rotation, rotate, so3_exp
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.refinement import TwoViews, tilt_and_heading
from torchrefrac.scene import Interfaces, Observations, Scene

HEIGHT = 30.0
PIXEL_SIGMA, GRAVITY_SIGMA = 0.5, math.radians(1.0)
MAX_ERROR = 4.0


@dataclass(frozen=True)
class Planted:
    """basin: the truth; views: what was measured of it; truth (8) in the terms of `views`; pixels (2, N, 2)."""

    basin: Any
    views: TwoViews
    truth: Tensor
    pixels: Tensor

    @property
    def everything(self) -> Tensor:
        return torch.ones(1, len(self.views), dtype=torch.bool)

    def start(self, draw, size: float = 1.0) -> Tensor:
        """A model (1, 8) about a degree and a centimetre from the truth."""
        scale = torch.tensor([0.02] * 5 + [1.0] * 3, dtype=torch.float64)
        return (self.truth + size * scale * draw.normal(8))[None]

    def refined(self, start: Tensor | None = None, max_error: float = MAX_ERROR) -> Tensor:
        """The state (8) that the refinement ends at, from the truth unless told otherwise."""
        models = self.truth[None] if start is None else start
        return self.views.refine(models, max_error, 30, tolerance=1e-8).states[0]

    def covariance(self) -> Tensor:
        """The Cramér-Rao bound (8, 8): from the quadratic model at the truth."""
        hessian = self.views.linearize(self.truth[None], 1e9, self.everything).hessian[0]
        return PIXEL_SIGMA**2 * torch.linalg.inv(hessian)


@pytest.fixture
def make_planted(make_basin, draw) -> Callable[..., Planted]:
    """`make_planted(points=60, noise=0.0, gravity_error=0.0, basin=None, ...)`: pixels and verticals with errors of
    that many pixels and radians; the rest goes to `TwoViews`. A basin given is measured once more."""

    def make(points: int = 60, noise: float = 0.0, gravity_error: float = 0.0, basin=None, **options) -> Planted:
        basin = make_basin(points=points) if basin is None else basin
        exact, _ = basin.project()
        pixels = exact + noise * draw.normal(*exact.shape)
        plane = basin.lens.plane_from_pixels(pixels)
        turn = so3_exp(gravity_error * draw.normal(2, 3))
        cam_from_level = level_rotation(rotate(turn, basin.down_in_cam))
        options = {"gravity_sigma": GRAVITY_SIGMA, "pixel_sigma": PIXEL_SIGMA, **options}
        index = torch.tensor(basin.index_ratio, dtype=torch.float64)
        views = TwoViews(plane[0], plane[1], cam_from_level, basin.lens.focal, index, HEIGHT, **options)
        return Planted(basin, views, _model(cam_from_level, basin.rotation, basin.center), pixels)

    return make


def _model(cam_from_level: Tensor, rotation: Tensor, center: Tensor) -> Tensor:
    """Two cameras as a model (8): scaled and turned so that the first stands at (0, 0, HEIGHT) with heading 0."""
    tilt, heading = tilt_and_heading(cam_from_level, rotation)
    across = (center[1] - center[0] * center.new_tensor((1.0, 1.0, 0.0))) * (HEIGHT / center[0, 2])
    turned = rotate(heading_rotation(heading[0]), across)
    tilt, heading = tilt_and_heading(cam_from_level, rotation @ heading_rotation(-heading[0]))
    return torch.cat((tilt.flatten(), heading[1:], turned))


@pytest.fixture
def with_outliers(draw) -> Callable[[Planted, float], Planted]:
    """`with_outliers(planted, part)`: the last `part` of the matches go to random places of the second image."""

    def make(planted: Planted, part: float) -> Planted:
        lens, wrong = planted.basin.lens, int(part * len(planted.views))
        anywhere = draw.uniform(0.0, 1.0, wrong, 2) * torch.tensor((lens.width, lens.height), dtype=torch.float64)
        plane2 = planted.views.plane2.clone()
        plane2[-wrong:] = lens.plane_from_pixels(anywhere)
        return replace(planted, views=replace(planted.views, plane2=plane2))

    return make


@pytest.mark.parametrize("gravity_sigma", [0.0, GRAVITY_SIGMA, math.inf])
def test_without_noise_the_truth_is_found_from_beside_it(make_planted, draw, gravity_sigma):
    planted = make_planted(gravity_sigma=gravity_sigma)
    start = planted.start(draw)
    if gravity_sigma == 0.0:
        start[:, :4] = 0.0

    found = planted.refined(start, max_error=200.0)

    torch.testing.assert_close(found, planted.truth, rtol=0.0, atol=1e-6)


def test_many_models_are_refined_each_by_itself(make_planted, draw):
    planted = make_planted(noise=PIXEL_SIGMA)
    starts = torch.cat([planted.start(draw, size=0.3) for _ in range(6)])

    together = planted.views.refine(starts, 40.0, 30)

    for k, start in enumerate(starts):
        alone = planted.views.refine(start[None], 40.0, 30)
        torch.testing.assert_close(together.states[k], alone.states[0], rtol=1e-6, atol=1e-6)
    assert together.converged.all()


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_gradient_is_that_of_the_cost(make_planted, draw, noise):
    planted = make_planted(noise=noise)
    model = planted.start(draw, size=1e-3).requires_grad_()

    quadratic = planted.views.linearize(model, 1e9, planted.everything)
    (gradient,) = torch.autograd.grad(quadratic.cost.sum(), model)

    scale = quadratic.hessian[0].diagonal().sqrt() * quadratic.cost.sqrt()
    difference = ((quadratic.gradient - gradient)[0] / scale).detach()
    assert (difference.abs() < 1e-3 * (gradient[0] / scale).norm()).all()


def test_the_hessian_is_that_of_gauss_and_newton(make_planted):
    """Without noise the second derivatives of the errors do not count, and both Hessians are the same."""
    planted = make_planted(points=20)

    def cost(model: Tensor) -> Tensor:
        return 0.5 * planted.views.errors(model[None]).error.square().sum()

    hessian = torch.func.hessian(cost)(planted.truth)
    quadratic = replace(planted.views, gravity_sigma=math.inf).linearize(
        planted.truth[None], 1e9, torch.ones(1, 20) > 0
    )

    units = hessian.diagonal().rsqrt()
    torch.testing.assert_close(
        units[:, None] * quadratic.hessian[0] * units, units[:, None] * hessian * units, rtol=0.0, atol=1e-7
    )


def test_the_error_is_no_larger_than_the_cramer_rao_bound_and_has_no_bias(make_planted):
    """Of 60 draws of the pixels and of both verticals."""
    first = make_planted(points=300)
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


def test_exact_verticals_are_held_and_the_rest_is_as_good_as_the_bound(make_planted):
    planted = make_planted(noise=PIXEL_SIGMA, points=300, gravity_sigma=0.0)

    error = planted.refined() - planted.truth

    assert torch.equal(error[:4], torch.zeros(4, dtype=torch.float64))
    deviation = planted.covariance().diagonal()[4:].sqrt()
    assert (error[4:].abs() < 3.5 * deviation).all()


def test_with_gravity_unknown_the_tilts_take_up_any_error_of_the_verticals(make_planted):
    planted = make_planted(gravity_error=math.radians(3.0), gravity_sigma=math.inf)
    start = planted.truth.clone()
    start[:4] = 0.0

    found = planted.refined(start[None], max_error=200.0)

    torch.testing.assert_close(found, planted.truth, rtol=0.0, atol=1e-6)


def test_the_prior_is_worth_what_gravity_sigma_says(make_planted):
    planted = make_planted(gravity_sigma=0.002)
    model = planted.truth.clone()
    model[:4] = torch.tensor((0.001, -0.002, 0.003, 0.004))
    free = replace(planted.views, gravity_sigma=math.inf)

    with_it, without = (views.linearize(model[None], 1e3, planted.everything) for views in (planted.views, free))
    costs = [views.costs(model[None], 1e3) for views in (planted.views, free)]

    prior = PIXEL_SIGMA**2 * (model[:4] / 0.002).square().sum()[None]
    assert_matches(with_it.cost - without.cost, 0.5 * prior, slack=1e4)
    assert_matches((with_it.gradient - without.gradient)[0, :4], PIXEL_SIGMA**2 * model[:4] / 0.002**2, slack=1e5)
    assert_matches(costs[0] - costs[1], prior, slack=1e4)


@pytest.mark.parametrize("gravity_sigma", [0.0, GRAVITY_SIGMA])
def test_a_known_heading_is_held(make_planted, draw, gravity_sigma):
    planted = make_planted(noise=PIXEL_SIGMA, gravity_sigma=gravity_sigma, known_heading=0.5)
    start = planted.start(draw, size=0.2)
    start[:, :4], start[:, 4] = 0.0, planted.truth[4]

    found = planted.refined(start, max_error=40.0)

    assert found[4] == start[0, 4]
    assert (found[5:] != start[0, 5:]).all()
    assert (found[:4] != 0.0).any() == (gravity_sigma > 0.0)


def test_a_known_heading_makes_the_rest_more_certain(make_planted):
    basin = make_planted().basin
    free, held = (make_planted(basin=basin, known_heading=heading).covariance().diagonal() for heading in (None, 0.0))

    assert (held[5:] < free[5:]).all()


def test_it_is_the_bundle_adjustment_of_both_cameras_and_all_points(make_planted):
    planted = make_planted(points=150, noise=PIXEL_SIGMA, gravity_error=GRAVITY_SIGMA)
    views, basin = planted.views, planted.basin

    found = planted.refined(max_error=1e3)

    point, camera = torch.arange(150).repeat_interleave(2), torch.arange(2).repeat(150)
    seen = Observations(camera, point, planted.pixels[camera, point])
    water = Interfaces.level(views.index_ratio)
    report = adjust(
        Scene.create(Rigid(basin.rotation, basin.center), basin.lens, water, basin.points, seen),
        BundleOptions(
            loss="squared",
            pixel_sigma=PIXEL_SIGMA,
            solver=LevenbergMarquardtOptions(200, function_tolerance=1e-14),
        ),
        terms=[GravityPrior(-views.cam_from_level[..., 2], GRAVITY_SIGMA)],
    )
    adjusted = _model(views.cam_from_level, report.scene.views.rotation, report.scene.views.center)

    difference = (found - adjusted) / planted.covariance().diagonal().sqrt()
    assert ((planted.truth - adjusted) / planted.covariance().diagonal().sqrt()).abs().max() > 0.3
    assert difference.abs().max() < 0.05


def test_a_third_of_outliers_does_not_move_the_pose(make_planted, with_outliers):
    """Truncated at four standard deviations; against the bound of the right matches."""
    first = make_planted(points=300)
    right = replace(first, views=first.views.rows(torch.arange(210)))
    deviation = right.covariance().diagonal().sqrt()

    errors = []
    for _ in range(30):
        clean = make_planted(noise=PIXEL_SIGMA, gravity_error=GRAVITY_SIGMA, basin=first.basin)
        planted = with_outliers(clean, 0.3)
        errors.append((planted.refined(max_error=4.0 * PIXEL_SIGMA) - planted.truth) / deviation)

    assert torch.stack(errors).square().mean(dim=0).sqrt().max() < 1.5


def test_matches_beyond_max_error_do_not_count(make_planted, with_outliers):
    planted = make_planted(noise=0.2, points=80)
    far = with_outliers(planted, 0.25)
    error = far.views.errors(far.truth[None]).error[0].abs()
    inside = error < MAX_ERROR
    some = replace(far, views=far.views.rows(inside))
    everything = far.everything

    truncated, alone = (
        case.views.linearize(far.truth[None], MAX_ERROR, everything[:, : len(case.views)]) for case in (far, some)
    )

    assert 0 < int((~inside).sum()) <= 20
    assert_matches(truncated.cost, alone.cost + 0.5 * MAX_ERROR**2 * (~inside).sum(), slack=100.0)
    assert_matches(truncated.hessian, alone.hessian, slack=100.0)
    assert_matches(truncated.gradient, alone.gradient, slack=100.0)


@pytest.mark.parametrize("depth", [1.0, 300.0, 3e3])
def test_matches_of_absurd_depth_do_not_count_however_well_their_rays_meet(make_planted, depth):
    """Their rays meet within a pixel or two, but the bulk lies 80 to 100 deep."""
    planted = make_planted(points=60)
    points = planted.basin.points.clone()
    points[:, 2] = -80.0 - points[:, 2] % 20.0
    points[:4, 2] = -depth
    pixels, _ = replace(planted.basin, points=points).project()
    pixels[1, :4] += 1.0
    plane = planted.basin.lens.plane_from_pixels(pixels)
    views = replace(planted.views, plane1=plane[0], plane2=plane[1])

    found = views.refine(planted.truth[None], MAX_ERROR, 20).states[0]

    errors = views.errors(planted.truth[None])
    assert (errors.error[0, :4].abs() < MAX_ERROR).all()
    assert errors.possible.all()
    assert float(views.costs(planted.truth[None], MAX_ERROR)) == pytest.approx(4.0 * MAX_ERROR**2, rel=1e-6)
    torch.testing.assert_close(found, planted.truth, rtol=0.0, atol=1e-6)


def test_the_cost_is_the_truncated_sum_of_squared_errors(make_planted, with_outliers):
    planted = with_outliers(make_planted(noise=0.5, gravity_sigma=math.inf), 0.2)

    cost = planted.views.costs(planted.truth[None], MAX_ERROR)

    errors = planted.views.errors(planted.truth[None])
    near = errors.depth[errors.error.abs() < MAX_ERROR]
    low, high = near.quantile(0.1), near.quantile(0.9)
    bulk = (errors.depth >= 2.0 * low - high) & (errors.depth <= 2.0 * high - low)
    square = errors.error.square().clamp(max=MAX_ERROR**2)
    assert_matches(cost, torch.where(bulk & errors.possible, square, MAX_ERROR**2).sum(dim=-1))


def test_no_model_ends_below_the_water_and_one_that_is_there_costs_infinitely_much(make_planted):
    planted = make_planted(noise=PIXEL_SIGMA)
    models = planted.truth.repeat(2, 1)
    models[0, 7], models[1, 7] = 0.1, -5.0

    costs = planted.views.costs(models, MAX_ERROR)
    report = planted.views.refine(models[:1], 1e3, 30)

    assert costs.isfinite().tolist() == [True, False]
    assert report.states[0, 7] > 0.0


def test_without_any_match_inside_the_model_stays_where_it_is(make_planted):
    planted = make_planted(gravity_sigma=math.inf)
    views = replace(planted.views, plane2=planted.views.plane2 + 0.3)

    report = views.refine(planted.truth[None], 1e-3, 10)

    assert report.states.isfinite().all()
    assert_matches(report.states[0], planted.truth)


def test_the_points_of_exact_matches_are_theirs(make_planted):
    planted = make_planted()

    points = planted.views.points(planted.truth[None])[0]

    first = planted.basin.center[0] * torch.tensor((1.0, 1.0, 0.0), dtype=torch.float64)
    _, heading = tilt_and_heading(planted.views.cam_from_level[0], planted.basin.rotation[0])
    expected = rotate(heading_rotation(heading), planted.basin.points - first)
    torch.testing.assert_close(points, expected, rtol=0.0, atol=1e-7)


def test_the_poses_put_the_first_camera_above_the_origin_with_heading_0(make_planted):
    planted = make_planted(gravity_error=GRAVITY_SIGMA)

    rotation, center = planted.views.poses(planted.truth[None])

    assert center[0, 0].tolist() == [0.0, 0.0, HEIGHT]
    assert_matches(_model(planted.views.cam_from_level, rotation[0], center[0]), planted.truth, slack=100.0)
    assert_matches(-rotation[0, :, :, 2], planted.basin.down_in_cam, slack=10.0)


def test_rows_are_some_of_the_matches(make_planted):
    views, rows = make_planted().views, torch.tensor((7, 3, 50))

    some = views.rows(rows)

    assert len(some) == 3
    assert torch.equal(some.plane1, views.plane1[rows])
    assert torch.equal(some.plane2, views.plane2[rows])
    assert some.cam_from_level is views.cam_from_level
    assert len(views) == 60


def test_single_precision_gives_the_same_errors_to_a_hundredth_of_a_pixel(make_planted, draw):
    planted = make_planted(noise=PIXEL_SIGMA)
    model = planted.start(draw, size=0.1)

    single = planted.views.single().errors(model.float())

    double = planted.views.errors(model)
    assert single.error.dtype == single.depth.dtype == torch.float32
    torch.testing.assert_close(single.error.double(), double.error, rtol=0.0, atol=0.01)
    assert torch.equal(single.possible, double.possible)
