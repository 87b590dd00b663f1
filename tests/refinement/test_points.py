"""Points at the least reprojection error."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from tests.tolerances import DTYPES
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import Plane
from torchrefrac.minimal import triangulate, triangulation_angle
from torchrefrac.refinement import PointEstimate, refine_points
from torchrefrac.refraction import FlatInterface

LENS = (-0.12, 0.05, 1e-3, -2e-3, 0.01)


@dataclass(frozen=True)
class Sightings:
    """Ragged tracks: cameras (N), pixels (N, 2) without noise, point (N) into truth (n, 3)."""

    cameras: RefractiveCamera
    pixels: Tensor
    point: Tensor
    truth: Tensor

    def refine(self, noise: Tensor | float = 0.0, start: Tensor | None = None, **options: Any) -> PointEstimate:
        """From `start`, by default two length units beside the truth."""
        beside = self.truth + self.truth.new_tensor((1.0, -1.0, 1.4))
        return refine_points(
            self.cameras, self.pixels + noise, self.point, beside if start is None else start, **options
        )

    def of(self, rows: Tensor) -> "Sightings":
        return replace(self, cameras=self.cameras[rows], pixels=self.pixels[rows], point=self.point[rows])


@pytest.fixture
def sightings_of(make_basin) -> Callable[..., Sightings]:
    """`sightings_of(cameras=5, points=40, land=0, ...)`: what the cameras around a basin see of it."""

    def make(cameras: int = 5, points: int = 40, seen_by: int = 2, **scene) -> Sightings:
        basin = make_basin(cameras=cameras, points=points, seen_by=seen_by, **scene)
        pixels, seen = basin.project()
        track, image = seen.T.nonzero(as_tuple=True)
        return Sightings(basin.cameras[image], pixels[image, track], track, basin.points)

    return make


@pytest.fixture
def tower() -> Sightings:
    """One point, 40 deep, seen from 30 above the water on one side and from 400 on the other."""
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)).expand(4, 3, 3)
    center = rotation.new_tensor([[-25.0, 0.0, 30.0], [0.0, 20.0, 30.0], [180.0, 10.0, 400.0], [170.0, -90.0, 400.0]])
    cameras = RefractiveCamera(Intrinsics.create(1024, 768, 667.0), rotation, center, FlatInterface(1.33))
    truth = rotation.new_tensor([[3.0, -2.0, -40.0]])
    return Sightings(cameras, cameras.project(truth)[0], torch.zeros(4, dtype=torch.long), truth)


@pytest.fixture
def draws_of(draw) -> Callable[[Sightings, int, float], tuple[Sightings, Tensor]]:
    """`draws_of(one, count, sigma)`: the sightings of one point, `count` times over, and their noise."""

    def make(one: Sightings, count: int, sigma: float) -> tuple[Sightings, Tensor]:
        views = len(one.point)
        many = Sightings(
            one.cameras[torch.arange(views).repeat(count)],
            one.pixels.repeat(count, 1),
            torch.arange(count).repeat_interleave(views),
            one.truth.expand(count, 3),
        )
        return many, sigma * draw.normal(count * views, 2)

    return make


@pytest.mark.parametrize("index_ratio", [1.33, 1.0], ids=["water", "air"])
@pytest.mark.parametrize("distortion", [(0.0,) * 5, LENS], ids=["no lens", "lens"])
@pytest.mark.parametrize("land", [0, 15, 40], ids=["wet", "both", "dry"])
def test_without_noise_the_points_are_found_whatever_medium_they_lie_in(sightings_of, land, distortion, index_ratio):
    sightings = sightings_of(land=land, distortion=distortion, index_ratio=index_ratio)

    estimate = sightings.refine()

    assert estimate.valid.all()
    assert estimate.in_front.all()
    torch.testing.assert_close(estimate.points, sightings.truth, rtol=0.0, atol=1e-9)
    assert estimate.rms.max() < 1e-8
    assert torch.equal(estimate.num_views, torch.bincount(sightings.point))


def test_points_through_a_tilted_wall_are_found(draw):
    wall = FlatInterface(1.5, plane=Plane((0.1, 0.0, 1.0), 0.2))
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)).expand(3, 3, 3)
    center = torch.cat((draw.uniform(-2.0, 2.0, 3, 2), draw.uniform(3.0, 4.0, 3, 1)), dim=-1)
    cameras = RefractiveCamera(Intrinsics.create(1000, 1000, 800.0), rotation, center, wall)
    truth = torch.cat((draw.uniform(-1.0, 1.0, 20, 2), draw.uniform(-3.0, -1.0, 20, 1)), dim=-1)
    image, point = torch.arange(3).repeat(20), torch.arange(20).repeat_interleave(3)
    pixels, _ = cameras[image].project(truth[point])

    estimate = refine_points(cameras[image], pixels, point, truth + 0.1 * draw.normal(20, 3))

    assert estimate.valid.all()
    torch.testing.assert_close(estimate.points, truth, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("loss_scale", [None, 0.4], ids=["squares", "huber"])
def test_each_point_is_where_scipy_puts_it(sightings_of, draw, loss_scale):
    sightings = sightings_of(points=6, land=2, seen_by=3, distortion=LENS)
    noise = 0.3 * draw.normal(*sightings.pixels.shape)

    estimate = sightings.refine(noise, loss_scale=loss_scale, max_iterations=40)

    assert estimate.valid.all()
    for i, start in enumerate(sightings.truth):
        rows = sightings.point == i
        cameras, pixels = sightings.cameras[rows], (sightings.pixels + noise)[rows]
        found = least_squares(_residuals(cameras, pixels, loss_scale), start, xtol=1e-12, ftol=1e-12, gtol=1e-12).x
        torch.testing.assert_close(estimate.points[i], torch.from_numpy(found), rtol=0.0, atol=2e-5)
        square = (cameras.project(estimate.points[i])[0] - pixels).square().sum(dim=-1)
        torch.testing.assert_close(estimate.rms[i], square.mean().sqrt())


def _residuals(cameras: RefractiveCamera, pixels: Tensor, scale: float | None) -> Callable:
    """Reprojection errors as scipy wants them; with a loss the root of it, one for each observation."""

    def residuals(x) -> Any:
        error = cameras.project(torch.from_numpy(x))[0] - pixels
        if scale is None:
            return error.flatten().numpy()
        length = error.norm(dim=-1)
        return torch.where(length > scale, (2.0 * scale * length - scale**2).clamp(min=0.0).sqrt(), length).numpy()

    return residuals


@pytest.mark.parametrize("height", [0.0, 45.0], ids=["wet", "dry"])
def test_the_covariance_is_the_scatter_of_noisy_draws(tower, draws_of, height):
    truth = tower.truth + tower.truth.new_tensor((0.0, 0.0, height))
    one = replace(tower, truth=truth, pixels=tower.cameras.project(truth)[0])
    many, noise = draws_of(one, 2000, 0.4)

    estimate = many.refine(noise, pixel_sigma=0.4)

    expected = one.refine(start=truth, pixel_sigma=0.4).covariance[0]
    error = estimate.points - truth
    assert estimate.valid.all()
    sigma = expected.diagonal().sqrt()
    torch.testing.assert_close(error.square().mean(dim=0).sqrt(), sigma, rtol=0.05, atol=0.0)
    torch.testing.assert_close(estimate.covariance.mean(dim=0), expected, rtol=0.05, atol=0.0)
    scatter = error.T @ error / len(error)
    assert ((scatter - expected) / (sigma[:, None] * sigma)).abs().max() < 0.1


def test_the_covariance_grows_with_the_square_of_the_noise(sightings_of):
    sightings = sightings_of()

    torch.testing.assert_close(
        sightings.refine(pixel_sigma=3.0).covariance, 9.0 * sightings.refine(pixel_sigma=1.0).covariance
    )


def test_in_pixels_the_points_are_better_than_at_the_least_distance_to_the_rays(tower, draws_of):
    many, noise = draws_of(tower, 1000, 0.5)
    origins, directions, _ = many.cameras.cast_rays(many.pixels + noise)
    linear, _ = triangulate(origins.view(1000, 4, 3), directions.view(1000, 4, 3))

    estimate = many.refine(noise, start=linear)

    assert estimate.valid.all()
    assert _rms(estimate.points - many.truth) < 0.8 * _rms(linear - many.truth)


def _rms(error: Tensor) -> float:
    return float(error.square().sum(dim=-1).mean().sqrt())


def test_ragged_tracks_in_any_order_give_the_same_as_one_by_one(sightings_of, generator, draw):
    sightings = sightings_of(cameras=6, points=30, land=10)
    noise = 0.5 * draw.normal(*sightings.pixels.shape)
    assert len(torch.bincount(sightings.point).unique()) > 2
    order = torch.randperm(len(noise), generator=generator)

    shuffled = sightings.of(order).refine(noise[order])

    for i in range(30):
        rows = sightings.point == i
        single = replace(sightings.of(rows), point=torch.zeros(int(rows.sum()), dtype=torch.long))
        alone = replace(single, truth=sightings.truth[i : i + 1]).refine(noise[rows])
        for name in ("points", "covariance", "rms", "angle"):
            torch.testing.assert_close(getattr(shuffled, name)[i], getattr(alone, name)[0], rtol=1e-7, atol=1e-8)
        assert alone.valid.all()
    assert shuffled.valid.all()


def test_the_angle_is_the_largest_between_the_rays_in_the_medium_of_the_point(sightings_of):
    sightings = sightings_of(cameras=6, land=10)
    _, wet, _ = sightings.cameras.cast_rays(sightings.pixels)
    dry = sightings.cameras.view_directions(sightings.pixels)
    directions = torch.where(sightings.truth[sightings.point, 2:] >= 0.0, dry, wet)

    angle = sightings.refine().angle

    for i in range(40):
        of_point = directions[sightings.point == i]
        expected = triangulation_angle(of_point, torch.ones(len(of_point), dtype=torch.bool))
        torch.testing.assert_close(angle[i], expected, rtol=0.0, atol=1e-9)


def test_a_point_crosses_the_surface_where_the_cost_falls(sightings_of):
    sightings = sightings_of(land=20)
    mirrored = sightings.truth * sightings.truth.new_tensor((1.0, 1.0, -0.1))

    estimate = sightings.refine(start=mirrored, max_iterations=30)

    assert estimate.valid.double().mean() > 0.9
    torch.testing.assert_close(estimate.points[estimate.valid], sightings.truth[estimate.valid], rtol=0.0, atol=1e-7)


def test_an_outlier_moves_a_point_less_under_a_huber_loss(sightings_of, draw):
    sightings = sightings_of(cameras=6, seen_by=4)
    noise = 0.2 * draw.normal(*sightings.pixels.shape)
    noise[torch.searchsorted(sightings.point, torch.arange(40))] += 30.0

    plain, robust = sightings.refine(noise), sightings.refine(noise, loss_scale=0.5, max_iterations=30)

    assert robust.valid.all()
    assert _rms(robust.points - sightings.truth) < 0.3 * _rms(plain.points - sightings.truth)
    assert (robust.rms > plain.rms).all()


def test_a_point_of_one_view_or_none_stays_and_is_not_valid(sightings_of):
    sightings = sightings_of(points=3)
    first = torch.searchsorted(sightings.point, torch.arange(2))
    rows = torch.cat((first[:1], (sightings.point == 1).nonzero()[:, 0]))
    start = sightings.truth + 1.0

    estimate = sightings.of(rows).refine(start=start)

    assert estimate.valid.tolist() == [False, True, False]
    assert torch.equal(estimate.points[[0, 2]], start[[0, 2]])
    assert estimate.num_views.tolist() == [1, len(rows) - 1, 0]
    assert estimate.in_front.tolist() == [True, True, False]
    assert estimate.angle[[0, 2]].tolist() == [0.0, 0.0]
    _assert_finite(estimate)


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("max_iterations", [10, 60])
def test_parallel_rays_leave_the_point_at_its_start(noise, max_iterations):
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)).expand(2, 3, 3)
    center = rotation.new_tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    cameras = RefractiveCamera(Intrinsics.create(1000, 1000, 800.0), rotation, center, FlatInterface(1.33))
    pixels = rotation.new_tensor([[600.0 - noise, 400.0], [600.0 + noise, 400.0]])
    start = rotation.new_tensor([[0.5, 0.0, -0.5]])

    estimate = refine_points(cameras, pixels, torch.zeros(2, dtype=torch.long), start, max_iterations=max_iterations)

    assert not estimate.valid
    assert torch.equal(estimate.points, start)
    _assert_finite(estimate)


def test_two_views_from_one_place_leave_the_point_at_its_start(tower):
    rows = torch.tensor([0, 0])

    estimate = tower.of(rows).refine()

    assert not estimate.valid
    assert torch.equal(estimate.points, tower.truth + tower.truth.new_tensor((1.0, -1.0, 1.4)))
    _assert_finite(estimate)


def test_a_point_that_lies_behind_a_camera_is_not_valid(tower):
    start = tower.truth.new_tensor([[0.0, 0.0, 200.0]])

    estimate = tower.refine(start=start, max_iterations=0)

    assert not estimate.in_front
    assert not estimate.valid
    assert torch.equal(estimate.points, start)
    _assert_finite(estimate)


def _assert_finite(estimate: PointEstimate) -> None:
    for name in ("points", "covariance", "rms", "angle"):
        assert getattr(estimate, name).isfinite().all(), name


def test_no_point_ends_worse_than_it_began(sightings_of, draw):
    sightings = sightings_of(land=10)
    noise, start = 2.0 * draw.normal(*sightings.pixels.shape), sightings.truth + 5.0 * draw.normal(40, 3)

    before = sightings.refine(noise, start=start, max_iterations=0)
    after = sightings.refine(noise, start=start, max_iterations=3)

    assert (after.rms <= before.rms).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_results_have_the_dtype_of_the_pixels_and_points(sightings_of, dtype):
    sightings = sightings_of(land=10)

    estimate = refine_points(
        sightings.cameras.to(dtype=dtype),
        sightings.pixels.to(dtype),
        sightings.point,
        (sightings.truth + 1.0).to(dtype),
    )

    assert estimate.valid.all()
    assert {getattr(estimate, name).dtype for name in ("points", "covariance", "rms", "angle")} == {dtype}
    tolerance = 1e-9 if dtype == torch.float64 else 2e-3
    torch.testing.assert_close(estimate.points.double(), sightings.truth, rtol=0.0, atol=tolerance)


def test_nothing_to_refine_gives_nothing(sightings_of):
    sightings = sightings_of(points=2)
    nothing = replace(sightings.of(torch.zeros(0, dtype=torch.long)), truth=sightings.truth[:0]).refine()
    unseen = sightings.of(torch.zeros(0, dtype=torch.long)).refine()

    assert nothing.points.shape == (0, 3)
    assert nothing.covariance.shape == (0, 3, 3)
    assert nothing.valid.shape == (0,)
    assert not unseen.valid.any()
    _assert_finite(unseen)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pixels": torch.zeros(4, 3)}, r"pixels has shape \(4, 3\), but must be \(N, 2\)"),
        ({"pixels": torch.zeros(4, 2, dtype=torch.long)}, "pixels has dtype torch.int64, but must be a floating-point"),
        ({"pixels": torch.full((4, 2), torch.nan)}, "pixels is nan somewhere, but must be finite"),
        ({"points": torch.zeros(3)}, r"points has shape \(3,\), but must be \(n, 3\)"),
        ({"points": torch.full((1, 3), torch.inf)}, "points is inf somewhere, but must be finite"),
        ({"point": torch.zeros(4)}, "point has dtype torch.float32, but must hold row numbers of points, torch.long"),
        ({"point": torch.zeros(3, dtype=torch.long)}, r"cameras \(4,\), pixels \(4,\) and point \(3,\)"),
        ({"point": torch.tensor([0, 0, 0, 1])}, "point holds ids from 0 to 1, but must number the 1 rows of points"),
        ({"point": torch.tensor([0, 0, 0, -1])}, "point holds ids from -1 to 0"),
        ({"pixel_sigma": 0.0}, "pixel_sigma is 0, but must be finite and above 0"),
        ({"loss_scale": -1.0}, "loss_scale is -1, but must be finite and above 0"),
        ({"max_iterations": -1}, "max_iterations is -1, but must be finite and at least 0"),
    ],
)
def test_what_does_not_fit_is_refused(tower, change, message):
    given = {"pixels": tower.pixels, "point": tower.point, "points": tower.truth} | change

    with pytest.raises(ValueError, match=message):
        refine_points(tower.cameras, **given)


def test_cameras_that_are_not_one_for_each_observation_are_refused(tower):
    with pytest.raises(ValueError, match=r"cameras \(\), pixels \(4,\) and point \(4,\)"):
        refine_points(tower.cameras[0], tower.pixels, tower.point, tower.truth)
