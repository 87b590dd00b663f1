"""The refractive epipolar error of two pixels."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from tests.tolerances import DTYPES, TOLERANCE
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import so3_exp, triples
from torchrefrac.minimal import triangulate
from torchrefrac.refinement.epipolar import (
    EpipolarError,
    EpipolarJacobian,
    Views,
    epipolar_error,
    epipolar_jacobian,
    rays_in_water,
)
from torchrefrac.refraction import FlatInterface


@dataclass(frozen=True)
class Pair:
    """Two cameras, rotation (*B, 2, 3, 3) and center (*B, 2, 3), points (*B, n, 3) and their pixels (*B, 2, n, 2)."""

    lens: Intrinsics
    index_ratio: Tensor
    rotation: Tensor
    center: Tensor
    points: Tensor
    pixels: Tensor

    @property
    def cameras(self) -> RefractiveCamera:
        return RefractiveCamera(self.lens, self.rotation, self.center, FlatInterface(self.index_ratio))

    @property
    def views(self) -> tuple[Views, Views]:
        return _view(self, 0), _view(self, 1)

    @property
    def error(self) -> EpipolarError:
        return epipolar_error(*self.views, self.index_ratio)

    @property
    def jacobian(self) -> EpipolarJacobian:
        return epipolar_jacobian(*self.views, self.index_ratio)

    def off_by(self, pixels: Tensor) -> "Pair":
        return replace(self, pixels=self.pixels + pixels)

    def to(self, dtype: torch.dtype) -> "Pair":
        tensors = ("index_ratio", "rotation", "center", "points", "pixels")
        return replace(
            self, lens=self.lens.to(dtype=dtype), **{name: getattr(self, name).to(dtype) for name in tensors}
        )


def _view(pair: Pair, k: int) -> Views:
    x, y = pair.lens.plane_from_pixels(pair.pixels[..., k, :, :]).unbind(dim=-1)
    rotation, center = pair.rotation[..., k, None, :, :], pair.center[..., k, None, :]
    return Views(triples.rows(rotation), triples.split(center), (x, y), (pair.lens.focal[0], pair.lens.focal[1]))


@pytest.fixture
def make_pair(make_basin, draw) -> Callable[..., Pair]:
    """`make_pair(*shape, points=40, tilt=0.2, land=0, index_ratio=1.33)`: exact pixels of cameras that are turned by
    about `tilt` radians; some may lie outside the image."""

    def make(*shape: int, points: int = 40, tilt: float = 0.2, land: int = 0, index_ratio: float = 1.33) -> Pair:
        basin = make_basin(*shape, points=points, land=land)
        turned = so3_exp(tilt * draw.normal(*shape, 2, 3)) @ basin.rotation
        basin = replace(basin, rotation=turned, index_ratio=index_ratio)
        lens = replace(basin.lens, focal=basin.lens.focal * basin.lens.focal.new_tensor((1.0, 1.1)))
        basin = replace(basin, lens=lens)
        pixels, _ = basin.project()
        index = torch.tensor(index_ratio, dtype=torch.float64)
        return Pair(lens, index, basin.rotation, basin.center, basin.points, pixels)

    return make


@pytest.mark.parametrize("index_ratio", [1.0, 1.33, 1.5])
@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_exact_matches_have_no_error_and_the_depth_of_their_point(make_pair, tilt, index_ratio):
    pair = make_pair(4, tilt=tilt, index_ratio=index_ratio)

    error = pair.error
    first, second = pair.views

    assert error.error.abs().max() < 1e-9
    torch.testing.assert_close(error.depth, -pair.points[..., 2], rtol=1e-9, atol=0.0)
    assert error.possible.all()
    rays = zip(*(rays_in_water(view, pair.index_ratio) for view in (first, second)), strict=True)
    points, _ = triangulate(*(torch.stack(pair, dim=-2) for pair in rays))
    torch.testing.assert_close(points, pair.points, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.0])
def test_it_is_the_smallest_correction_of_both_pixels_that_makes_the_rays_meet(make_pair, draw, sigma):
    exact = make_pair(points=40)
    pair = exact.off_by(sigma * draw.normal(2, 40, 2))
    shortest = torch.tensor([(2.0 * _nearest(pair, i).cost) ** 0.5 for i in range(40)], dtype=torch.float64)

    judged = (shortest > 0.3) & (shortest < 4.0)
    assert judged.sum() >= 7
    torch.testing.assert_close(pair.error.error.abs()[judged], shortest[judged], rtol=0.01, atol=0.0)
    torch.testing.assert_close(pair.jacobian.error.abs()[judged], shortest[judged], rtol=1e-3, atol=0.0)


def _nearest(pair: Pair, i: int):
    """The search for the point of least reprojection error."""

    def residual(x):
        seen, _ = pair.cameras.project(torch.from_numpy(x).expand(2, 3))
        return (seen - pair.pixels[:, i]).flatten().numpy()

    return least_squares(residual, pair.points[i].numpy(), xtol=1e-12, ftol=1e-12, gtol=1e-12)


def test_its_variance_is_that_of_the_pixels(make_pair, draw):
    pair = make_pair(points=40)

    error = pair.off_by(0.5 * draw.normal(2000, 2, 40, 2)).error.error

    assert float(error.square().mean().sqrt()) == pytest.approx(0.5, rel=0.02)
    assert error.mean().abs() < 0.01


def test_exchanging_the_views_changes_the_sign_at_most(make_pair, draw):
    pair = make_pair(3).off_by(draw.normal(3, 2, 40, 2))
    swapped = replace(pair, rotation=pair.rotation.flip(1), center=pair.center.flip(1), pixels=pair.pixels.flip(1))

    one, two = pair.error, swapped.error

    torch.testing.assert_close(one.error.abs(), two.error.abs(), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(one.depth, two.depth, rtol=1e-9, atol=0.0)
    assert torch.equal(one.possible, two.possible)


def test_points_above_the_water_have_a_negative_depth_and_are_not_possible(make_pair):
    pair = make_pair(points=20, land=8)

    error = pair.error

    assert (error.depth[:8] < 0.0).all()
    assert error.down.all()
    assert error.possible.tolist() == [False] * 8 + [True] * 12


@pytest.mark.parametrize("up", [[0], [1], [0, 1]], ids=["first", "second", "both"])
def test_rays_that_go_up_are_not_possible_even_if_their_lines_meet_in_the_water(make_pair, up):
    """Turned by half a turn about x and mirrored, a camera sees the same lines from behind."""
    pair = make_pair(points=10)
    rotation, pixels = pair.rotation.clone(), pair.pixels.clone()
    rotation[up] *= torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)[:, None]
    pixels[up, :, 0] = pair.lens.width - pixels[up, :, 0]

    error = replace(pair, rotation=rotation, pixels=pixels).error

    assert error.error.abs().max() < 1e-9
    assert (error.depth > 0.0).all()
    assert not error.down.any()
    assert not error.possible.any()


@pytest.mark.parametrize(("index_ratio", "tolerance"), [(1.0, 2e-3), (1.0001, 0.02)])
def test_with_hardly_any_refraction_it_is_the_sampson_error_of_the_essential_matrix(
    make_pair, draw, index_ratio, tolerance
):
    """To second order in the error only: the constraints differ by the factor v_z1 v_z2."""
    pair = make_pair(index_ratio=index_ratio).off_by(draw.normal(2, 40, 2))

    torch.testing.assert_close(pair.error.error.abs(), _sampson(pair).abs(), rtol=tolerance, atol=tolerance)


def _sampson(pair: Pair) -> Tensor:
    """In pixels, from the fundamental matrix of two pinhole cameras (Hartley & Zisserman, Eq. 11.9)."""
    one, two = pair.rotation
    across = two @ (pair.center[0] - pair.center[1])
    essential = torch.linalg.cross(across[:, None].expand(3, 3), two @ one.mT, dim=0)
    scale = torch.cat((pair.lens.focal.reciprocal(), pair.lens.focal.new_ones(1)))
    fundamental = scale[:, None] * essential * scale
    x1, x2 = torch.cat((pair.pixels - pair.lens.principal_point, pair.pixels.new_ones(2, 40, 1)), dim=-1)
    line2, line1 = x1 @ fundamental.mT, x2 @ fundamental
    square = line1[:, :2].square().sum(dim=-1) + line2[:, :2].square().sum(dim=-1)
    return (x2 * line2).sum(dim=-1) / square.sqrt()


def test_the_jacobian_at_exact_matches_is_the_derivative_of_the_error(make_pair):
    pair = make_pair(points=12)

    def moved(turn: Tensor, shift: Tensor) -> Tensor:
        return replace(pair, rotation=pair.rotation @ so3_exp(turn), center=pair.center + shift).error.error

    still = torch.zeros(2, 3, dtype=torch.float64)
    by_turn, by_center = torch.autograd.functional.jacobian(moved, (still, still))

    jacobian = pair.jacobian
    assert jacobian.error.abs().max() < 1e-9
    for k in (0, 1):
        torch.testing.assert_close(torch.stack(jacobian.turn[k], dim=-1), by_turn[:, k], rtol=1e-8, atol=1e-6)
        torch.testing.assert_close(torch.stack(jacobian.center[k], dim=-1), by_center[:, k], rtol=1e-8, atol=1e-8)


def test_the_derivatives_of_noisy_matches_are_those_at_the_corrected_pixels(make_pair, draw):
    """Those are the projections of the point of least reprojection error."""
    pair = make_pair(points=10).off_by(draw.normal(2, 10, 2))
    at = torch.stack([torch.from_numpy(_nearest(pair, i).x) for i in range(10)])
    corrected = replace(pair, pixels=torch.stack([pair.cameras[k].project(at)[0] for k in (0, 1)]))

    noisy, there = pair.jacobian, corrected.jacobian

    for k in (0, 1):
        for kind in ("turn", "center"):
            found, expected = (torch.stack(getattr(by, kind)[k], dim=-1) for by in (noisy, there))
            assert ((found - expected).norm(dim=-1) < 3e-3 * expected.norm(dim=-1)).all()


def test_moving_both_cameras_alike_along_the_water_changes_nothing(make_pair, draw):
    jacobian = make_pair().off_by(draw.normal(2, 40, 2)).jacobian

    for axis in (0, 1):
        torch.testing.assert_close(jacobian.center[0][axis], -jacobian.center[1][axis], rtol=1e-12, atol=1e-12)


def test_hypotheses_are_leading_dimensions(make_pair, draw):
    pair = make_pair()
    turn = so3_exp(0.01 * draw.normal(3, 5, 2, 3))
    many = replace(
        pair,
        rotation=pair.rotation @ turn,
        center=pair.center + 0.1 * draw.normal(3, 5, 2, 3),
        pixels=pair.pixels,
    )

    error, jacobian = many.error, many.jacobian

    assert error.error.shape == error.depth.shape == error.possible.shape == (3, 5, 40)
    one = replace(many, rotation=many.rotation[2, 1], center=many.center[2, 1])
    torch.testing.assert_close(error.error[2, 1], one.error.error, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(error.depth[2, 1], one.error.depth, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(jacobian.turn[1][2][2, 1], one.jacobian.turn[1][2], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_dtype_is_kept_and_exact_matches_stay_exact_to_its_rounding(make_pair, dtype):
    pair = make_pair().to(dtype)

    error, jacobian = pair.error, pair.jacobian

    assert error.error.dtype == error.depth.dtype == jacobian.error.dtype == dtype
    assert error.error.abs().max() < TOLERANCE[dtype].pixel
    assert jacobian.error.abs().max() < TOLERANCE[dtype].pixel


def test_the_same_camera_twice_gives_finite_values(make_pair):
    pair = make_pair()
    twice = replace(
        pair,
        rotation=pair.rotation[:1].expand(2, 3, 3),
        center=pair.center[:1].expand(2, 3),
        pixels=pair.pixels[:1].expand(2, 40, 2),
    )

    assert twice.error.error.isfinite().all()
    assert twice.error.depth.isfinite().all()
    assert not twice.error.possible.any()
