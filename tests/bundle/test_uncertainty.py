"""Covariances of an adjusted scene: against dense algebra on derivatives by autograd, and against what errors do."""

from dataclasses import replace

import pytest
import torch
from scipy.integrate import quad

from tests.bundle.bundle_oracles import jacobian_of, weighted_residuals
from tests.bundle.changes import changed
from torchrefrac.bundle import (
    BundleOptions,
    CenterPrior,
    Expectations,
    GravityPrior,
    HeightPrior,
    KnownPoints,
    ScaleBars,
    adjust,
    adjust_pose,
    determinations,
    estimate_pixel_sigma,
    uncertainty,
    wished_changes,
)
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.geometry import so3_log
from torchrefrac.optim import LevenbergMarquardtOptions, SingularError, choice
from torchrefrac.optim import covariance as inverses
from torchrefrac.scene import Observations

SIGMA = 0.4
ONE = torch.ones(1, dtype=torch.float64)
WATER = ("index_ratio", "plane_tilt", "plane_height")


def _bar(truth):
    length = (truth.points[4] - truth.points[9]).norm()[None]
    return ScaleBars(torch.tensor([4]), torch.tensor([9]), length, 0.2 * ONE)


def _control(truth):
    ids = torch.tensor((3, 1))
    return KnownPoints(ids, truth.points[ids], 4.0 * torch.eye(3, dtype=torch.float64).expand(2, 3, 3))


def _height(truth):
    return HeightPrior(torch.tensor([1]), truth.views.center[1:2, 2], 0.5 * ONE)


def _say(problem, truth):
    """All that is said of how well things are known."""
    known = uncertainty(problem, truth, SIGMA)
    said = [known.pose, known.points, known.relative, known.index_ratio, known.planes, *known.intrinsics.values()]
    said += [torch.tensor(d.posterior) for d in determinations(problem, truth, SIGMA)]
    return [*said, torch.tensor(list(wished_changes(problem, truth, "focal", SIGMA).values()))]


def _first_fixed(count):
    fixed = torch.zeros(count, 6, dtype=torch.bool)
    fixed[0] = fixed[2, 3:] = True
    return fixed


CASES = {
    "free": {},
    "air": {"index_ratio": 1.0},
    "a bar": {"terms": [_bar]},
    "control points and a bar": {"terms": [_control, _bar]},
    "a height": {"terms": [_height]},
    "fixed views": {"fixed": True},
    "fixed views and a bar": {"fixed": True, "terms": [_bar]},
    "free intrinsics": {"refine": ("focal", "radial"), "cameras": 2, "expected": Expectations(focal=0.01)},
    "free water": {"refine": WATER},
    "two free waters": {"refine": ("focal", *WATER), "interfaces": 2, "terms": [_control]},
}


@pytest.fixture
def case_of(plant):
    """`case_of(name)`: the planted scene of CASES, and its problem."""

    def make(name, **changes):
        options = dict(CASES[name])
        scene = {key: options.pop(key) for key in ("index_ratio", "cameras", "interfaces") if key in options}
        planted = plant(views=5, points=20, **scene)
        terms = [term(planted.truth) for term in options.pop("terms", [])] + [planted.gravity]
        fixed = _first_fixed(5) if options.pop("fixed", False) else None
        return planted, planted.problem(terms=terms, fixed=fixed, pixel_sigma=SIGMA, **options | changes)

    return make


@pytest.mark.parametrize("name", CASES)
def test_a_banded_inverse_says_the_same_as_a_dense_one(case_of, monkeypatch, name):
    planted, problem = case_of(name)
    dense = _say(problem, planted.truth)
    monkeypatch.setattr(choice, "SMALL", 0)
    monkeypatch.setattr(inverses, "MAX_COVARIANCE", 0)

    banded = _say(problem, planted.truth)

    for one, other in zip(banded, dense, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)
    with pytest.raises(SingularError, match="is there in part only"):
        _ = uncertainty(problem, planted.truth, SIGMA).covariance


@pytest.mark.parametrize("name", CASES)
def test_all_of_it_is_the_inverse_of_the_whole_matrix_of_derivatives(case_of, name):
    """Bordered by inner constraints on the reduced unknowns."""
    planted, problem = case_of(name)
    layout, truth = problem.layout, planted.truth

    known = uncertainty(problem, truth, SIGMA)

    jacobian = jacobian_of(weighted_residuals(problem, planted.observations, truth), layout, truth)
    expected = SIGMA**2 * _bordered_inverse(jacobian, problem.linearize(truth).system.null_space)
    size = layout.size
    _assert_same(known.covariance, expected[:size, :size])
    images = torch.arange(layout.num_views)
    poses = 6 * images[:, None] + torch.arange(6)
    _assert_same(known.pose, expected[poses[:, :, None], poses[:, None]])
    reduced = torch.zeros(20, dtype=torch.bool) if layout.reduced is None else layout.reduced
    columns = torch.zeros(20, 3, dtype=torch.long)
    columns[~reduced] = size + torch.arange(3 * int((~reduced).sum())).view(-1, 3)
    columns[reduced] = layout.first_point + torch.arange(3 * int(reduced.sum())).view(-1, 3)
    _assert_same(known.points, expected[columns[:, :, None], columns[:, None]])
    of_points = jacobian[:, size:].mT @ jacobian[:, size:]
    alone = SIGMA**2 * torch.linalg.inv(of_points)[columns[:, :, None] - size, columns[:, None] - size]
    _assert_same(known.relative[~reduced], alone[~reduced])
    deviation = expected.diagonal().clamp(min=0.0).sqrt()
    for unknown, sigma in known.intrinsics.items():
        _assert_same(sigma, deviation[layout.intrinsics_columns(unknown, layout.cameras)])
    if layout.water:
        _assert_same(known.index_ratio, deviation[layout.medium_column("index_ratio")])
        _assert_same(known.planes, deviation[layout.plane_columns(layout.interfaces)])


def test_a_known_sigma_scales_everything(plant):
    planted = plant(views=5, points=20)
    problem = planted.problem(refine=("focal", *WATER))

    once, twice = (uncertainty(problem, planted.truth, sigma) for sigma in (SIGMA, 2.0 * SIGMA))

    assert (once.pixel_sigma, twice.pixel_sigma) == (SIGMA, 2.0 * SIGMA)
    _assert_same(twice.pose, 4.0 * once.pose)
    _assert_same(twice.points, 4.0 * once.points)
    _assert_same(twice.point_sigma, 2.0 * once.point_sigma)
    _assert_same(twice.intrinsics["focal"], 2.0 * once.intrinsics["focal"])
    _assert_same(twice.index_ratio, 2.0 * once.index_ratio)
    _assert_same(twice.planes, 2.0 * once.planes)
    _assert_same(twice.covariance, 4.0 * once.covariance)


def test_a_known_sigma_does_not_scale_what_measurements_say(case_of):
    """Centres that are measured well and images that say next to nothing: the measurements' own deviation is left."""
    planted, _ = case_of("free")
    images = torch.arange(5)
    prior = CenterPrior(images, planted.truth.views.center, 100.0 * torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    problem = planted.problem(terms=[prior, planted.gravity])

    known = uncertainty(problem, planted.truth, 1e4)

    center = known.pose[:, 3:, 3:].diagonal(dim1=1, dim2=2).sqrt()
    torch.testing.assert_close(center, torch.full_like(center, 0.1), rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("loss", ["huber", "cauchy", "truncated"])
def test_where_sigma_is_known_the_loss_does_not_matter(plant, loss):
    planted = plant(noise=1.0)

    robust, squared = (
        uncertainty(planted.problem(loss=name, loss_scale=0.5), planted.truth, SIGMA) for name in (loss, "squared")
    )

    assert torch.equal(robust.covariance, squared.covariance)
    assert torch.equal(robust.points, squared.points)


def test_an_observation_that_weighs_four_times_as_much_counts_as_four(plant):
    planted = plant()
    seen = planted.observations
    weighted = replace(planted, observations=replace(seen, weight=torch.full_like(seen.pixels[:, 0], 4.0)))

    plain, heavy = (uncertainty(p.problem(), p.truth, SIGMA) for p in (planted, weighted))

    _assert_same(heavy.points, 0.25 * plain.points)
    _assert_same(heavy.covariance, 0.25 * plain.covariance)


def test_what_is_fixed_has_no_variance_to_the_last_bit(case_of):
    planted, problem = case_of("fixed views and a bar")

    known = uncertainty(problem, planted.truth, SIGMA)

    fixed = problem.layout.fixed
    assert (known.pose[fixed] == 0.0).all()
    assert (known.pose.mT[fixed] == 0.0).all()
    assert (known.pose.diagonal(dim1=1, dim2=2)[~fixed] > 0.0).all()
    assert known.intrinsics == {}
    assert known.index_ratio == 0.0
    assert (known.planes == 0.0).all()


def test_points_that_are_fixed_have_no_variance_and_the_camera_that_of_a_resection(plant):
    planted = plant(views=2)
    layout = Layout.create(planted.truth, fix_points=True)
    problem = BundleProblem.create(planted.truth, layout, planted.problem().options)

    known = uncertainty(problem, planted.truth, SIGMA)

    jacobian = jacobian_of(weighted_residuals(problem, planted.observations, planted.truth), layout, planted.truth)
    poses = jacobian[:, :12]
    assert (known.points == 0.0).all()
    _assert_same(known.covariance, SIGMA**2 * torch.linalg.inv(poses.T @ poses))


def test_the_sigma_of_a_point_is_that_along_its_worst_axis(case_of):
    planted, problem = case_of("a bar")

    known = uncertainty(problem, planted.truth, SIGMA)

    _assert_same(known.point_sigma, torch.stack([torch.linalg.matrix_norm(c, 2).sqrt() for c in known.points]))


@pytest.mark.parametrize("name", ["free", "free water", "control points and a bar"])
def test_covariances_are_symmetric_and_positive(case_of, name):
    planted, problem = case_of(name)

    known = uncertainty(problem, planted.truth, SIGMA)

    for covariance in (known.points, known.pose, known.covariance):
        _assert_same(covariance, covariance.mT)
        values = torch.linalg.eigvalsh(covariance)
        assert (values > -1e-10 * values.amax(dim=-1, keepdim=True)).all()


def test_a_focal_length_that_level_cameras_in_air_leave_open_raises(plant, draw):
    """Whatever is stretched along the view with it looks the same."""
    planted = _level(plant(views=5, points=20, index_ratio=1.0), draw)

    with pytest.raises(SingularError, match="singular"):
        uncertainty(planted.problem(refine=("focal",)), planted.truth, SIGMA)

    assert uncertainty(planted.problem(), planted.truth, SIGMA).points.isfinite().all()


LOSSES = [("squared", 1.0), ("huber", 1.0), ("huber", 0.1), ("cauchy", 1.0), ("cauchy", 0.3)]


@pytest.mark.parametrize(("loss", "scale"), LOSSES)
def test_the_estimated_sigma_is_the_effective_one_of_gaussian_noise(plant, loss, scale):
    """One camera that sees many known points. The estimate itself is known to 1.4 %, for robust losses to about 2 %."""
    seen = plant(views=1, points=1200, noise=0.5)
    report = adjust_pose(seen.truth, BundleOptions(loss=loss, loss_scale=scale))

    found = estimate_pixel_sigma(report.problem, report.scene)

    assert found == pytest.approx(_effective_sigma(0.5, loss, scale), rel=0.05)
    assert uncertainty(report.problem, report.scene).pixel_sigma == found


@pytest.mark.parametrize(
    ("loss", "scale", "within"), [("squared", 1.0, 0.07), ("huber", 0.5, 0.1), ("cauchy", 1.0, 0.1)]
)
def test_it_is_so_too_where_a_third_of_what_was_measured_goes_into_unknowns(plant, loss, scale, within):
    planted = plant(views=8, points=150, noise=0.5)
    report = planted.adjusted(planted.truth, loss=loss, loss_scale=scale, terms=[planted.gravity])

    found = estimate_pixel_sigma(report.problem, report.scene)

    assert 0.2 < report.problem.unknowns_per_residual < 0.4
    assert found == pytest.approx(_effective_sigma(0.5, loss, scale), rel=within)


def test_a_robust_loss_is_at_most_a_little_worse_than_least_squares_and_small_scales_approach_the_median():
    """The oracle of the test above: the median of two coordinates has the efficiency pi / 4."""
    assert _effective_sigma(0.5, "squared", 1.0) == pytest.approx(0.5)
    assert _effective_sigma(0.5, "huber", 100.0) == pytest.approx(0.5)
    assert _effective_sigma(0.5, "cauchy", 100.0) == pytest.approx(0.5, rel=1e-3)
    assert _effective_sigma(0.5, "huber", 1e-3) == pytest.approx(0.5 * (4.0 / torch.pi) ** 0.5, rel=1e-2)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_wrong_observations_hardly_raise_the_estimate_of_a_robust_loss(plant, draw, loss):
    planted = plant(views=8, points=80, noise=0.5)
    wrong = planted.with_wrong_observations(draw)

    sigma = {
        name: estimate_pixel_sigma(report.problem, report.scene)
        for name in (loss, "squared")
        for report in [wrong.adjusted(planted.truth, loss=name, loss_scale=0.5, terms=[planted.gravity])]
    }

    assert 0.45 < sigma[loss] < 0.75
    assert sigma["squared"] > 2.0


def test_an_impossible_observation_says_nothing_about_the_noise(plant):
    planted = plant(views=4, points=40, noise=0.5)
    problem = planted.problem()
    points = planted.truth.points.clone()
    points[0] = planted.truth.views.center.mean(dim=0) + torch.tensor((0.0, 0.0, 500.0))
    of_first = planted.observations.point == 0

    errors = problem.squared_errors(changed(planted.truth, points=points))

    assert len(errors) == int((~of_first).sum())
    assert errors.amax() < 25.0


def test_over_many_draws_errors_are_as_large_as_their_covariances_say(plant, draw):
    """Gravity and centres are measured with noise of their own; half a pixel of noise, index ratio and plane free.

    Over n draws the mean of a chi-squared variable over its degrees of freedom d deviates by sqrt(2 / (n d)).
    """
    planted = plant(views=5, points=40)
    truth, draws = planted.truth, 45
    solver = LevenbergMarquardtOptions(max_iterations=30, function_tolerance=1e-7)
    options = planted.problem(pixel_sigma=0.5, refine=WATER, refine_unseen=True, solver=solver).options
    information = 4.0 * torch.eye(3, dtype=torch.float64).expand(5, 3, 3)
    sizes: dict[str, list[torch.Tensor]] = {"reduced": [], "points": [], "index": []}
    for _ in range(draws):
        tilt = torch.linalg.cross(planted.down_in_cam, 0.01 * draw.normal(5, 3))
        terms = [
            GravityPrior(planted.down_in_cam + tilt, 0.01),
            CenterPrior(torch.arange(5), truth.views.center + 0.5 * draw.normal(5, 3), information),
        ]
        report = adjust(_noisy(planted, draw), options, terms=terms)
        known = uncertainty(report.problem, report.scene, 0.5)

        reduced, points = _error(report.scene, truth)
        sizes["reduced"].append(reduced @ torch.linalg.solve(known.covariance, reduced) / len(reduced))
        solved = torch.linalg.solve(known.points, points[..., None])[..., 0]
        sizes["points"].append((points * solved).sum(dim=-1).mean() / 3.0)
        sizes["index"].append(_index_error(report.scene, truth) ** 2 / known.index_ratio**2)

    mean = {name: float(torch.stack(values).mean()) for name, values in sizes.items()}
    assert mean["reduced"] == pytest.approx(1.0, abs=3.0 * (2.0 / (34 * draws)) ** 0.5)
    assert mean["points"] == pytest.approx(1.0, abs=0.12)
    assert mean["index"] == pytest.approx(1.0, abs=3.0 * (2.0 / draws) ** 0.5)


@pytest.mark.parametrize(("loss", "scale"), [("huber", 0.25)])
def test_so_they_are_with_a_robust_loss_and_the_sigma_that_is_estimated(plant, draw, loss, scale):
    planted = plant(views=1, points=100)
    truth, draws = planted.truth, 30
    solver = LevenbergMarquardtOptions(max_iterations=20, function_tolerance=1e-7)
    options = BundleOptions(loss=loss, loss_scale=scale, solver=solver)
    sizes = []
    for _ in range(draws):
        report = adjust_pose(_noisy(planted, draw), options)
        known = uncertainty(report.problem, report.scene)

        error = _error(report.scene, truth)[0][:6]
        sizes.append(error @ torch.linalg.solve(known.covariance, error) / 6.0)

    assert float(torch.stack(sizes).mean()) == pytest.approx(1.0, abs=3.0 * (2.0 / (6 * draws)) ** 0.5)


def _noisy(planted, draw):
    """The true scene with half a pixel of noise."""
    seen = planted.observations
    return changed(planted.truth, observations=replace(seen, pixels=seen.pixels + 0.5 * draw.normal(len(seen), 2)))


def _index_error(state, truth):
    return state.interfaces.index_ratio[0] - truth.interfaces.index_ratio[0]


def _error(state, truth):
    """Of all reduced unknowns (rotations, centres, index ratio, tilts, height), and of the points."""
    pose = torch.cat(
        (so3_log(state.views.rotation @ truth.views.rotation.mT), state.views.center - truth.views.center), dim=-1
    )
    normal, offset = state.interfaces.normal[0], state.interfaces.offset[0]
    water = torch.stack((_index_error(state, truth), -normal[1], normal[0], offset))
    return torch.cat((pose.flatten(), water)), state.points - truth.points


def _effective_sigma(sigma, loss, scale):
    """Of the M-estimator of the centre of a normal distribution in the plane: the
    root of E[psi^2 / 2] over the mean slope of psi along an axis, psi' along the radius and psi / r across."""

    def weight(r):
        return {
            "squared": lambda: 1.0,
            "huber": lambda: min(1.0, scale / r),
            "cauchy": lambda: 1.0 / (1.0 + (r / scale) ** 2),
        }[loss]()

    def slope(r):
        return {
            "squared": lambda: 1.0,
            "huber": lambda: float(r < scale),
            "cauchy": lambda: (1.0 - (r / scale) ** 2) / (1.0 + (r / scale) ** 2) ** 2,
        }[loss]()

    def mean(function):
        def times_density(r):
            return function(r) * r / sigma**2 * torch.exp(torch.tensor(-0.5 * (r / sigma) ** 2)).item()

        return quad(times_density, 0.0, 10.0 * sigma, points=[min(scale, 9.0 * sigma)], limit=200)[0]

    spread = mean(lambda r: 0.5 * (weight(r) * r) ** 2)
    return spread**0.5 / mean(lambda r: 0.5 * (slope(r) + weight(r)))


def _level(planted, draw):
    """The same scene with all cameras looking straight down, and what they see then."""
    turn = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)).expand(5, 3, 3)
    truth = changed(planted.truth, rotation=turn)
    view, point = torch.arange(5).repeat_interleave(20), torch.arange(20).repeat(5)
    pixels, valid = truth.camera_of(view).project(truth.points[point])
    assert valid.all()
    noisy = pixels + 0.1 * draw.normal(*pixels.shape)
    order = torch.argsort(point, stable=True)
    return replace(planted, truth=truth, observations=Observations(view[order], point[order], noisy[order]))


def _bordered_inverse(jacobian, null_space):
    """Of [H C; C^T 0]: the covariance of least trace of the reduced unknowns. Zero for what nothing depends on."""
    alive = (jacobian != 0.0).any(dim=0).nonzero()[:, 0]
    unit = jacobian[:, alive].norm(dim=0)
    scaled = jacobian[:, alive] / unit
    border = torch.zeros(jacobian.shape[1], 0 if null_space is None else null_space.shape[1], dtype=torch.float64)
    if null_space is not None:
        border[: len(null_space)] = null_space
    border = torch.linalg.qr(border[alive] / unit[:, None]).Q
    count = border.shape[1]
    upper = torch.cat((scaled.T @ scaled, border), dim=1)
    lower = torch.cat((border.T, torch.zeros(count, count, dtype=torch.float64)), dim=1)
    inverse = torch.linalg.inv(torch.cat((upper, lower)))[: len(alive), : len(alive)] / unit[:, None] / unit
    whole = torch.zeros(jacobian.shape[1], jacobian.shape[1], dtype=torch.float64)
    whole[alive[:, None], alive] = inverse
    return whole


def _assert_same(actual, expected):
    torch.testing.assert_close(actual, expected, rtol=1e-6, atol=1e-8 * float(expected.abs().max()))
