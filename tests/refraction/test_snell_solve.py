"""The refrax ratio: against the exact root, against slow oracles, and the laws that it obeys.

A case is (height, depth, distance, index_ratio). It is constructed: choose the tangent of the angle of incidence, then
add up the horizontal way in air and in water to the distance. That gives its refrax ratio but for the rounding of the
case, which costs digits near grazing; to the last digit it is the root of the rounded numbers in extended precision.
"""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from tests.tolerances import DTYPES, EXACT, TOLERANCE, assert_matches
from torchrefrac.refraction import solve_refrax
from torchrefrac.refraction.iterations import Equation, lower_bound

METHODS = ["halley", "newton", "companion"]


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_refrax_ratio_is_exact_over_six_decades_of_depth_and_up_to_grazing_rays(draw, dtype):
    case = _many_cases(draw, dtype)

    exact = _in_extended_precision(*case)

    for method in ("halley", "newton"):
        error = np.abs(_extended(solve_refrax(*case, method=method)) - exact) / exact
        assert float(error.max()) < TOLERANCE[dtype].solve


@pytest.mark.parametrize("nearly_one", [False, True], ids=["any index ratio", "index ratio nearly 1"])
@pytest.mark.parametrize("method", ["halley", "newton"])
def test_constructed_truth_is_met_as_far_as_the_rounding_of_the_case_allows(draw, method, nearly_one):
    case, truth = _cases(draw, 20_000, nearly_one=nearly_one)

    ratio = solve_refrax(*case, method=method)

    assert ((ratio - truth) / truth).abs().max() < 2.0 * EXACT.solve


def test_bracketed_root_of_the_horizontal_offset_is_the_same(draw):
    case, _ = _cases(draw, 300)

    ratio = solve_refrax(*case)

    oracle = [_refrax_by_bracketing(*numbers) for numbers in torch.stack(case, dim=-1).tolist()]
    torch.testing.assert_close(ratio, torch.tensor(oracle, dtype=torch.float64), rtol=2.0 * EXACT.solve, atol=0.0)


def test_the_quartic_of_the_paper_has_the_same_root(draw):
    case, _ = _cases(draw, 20_000)

    torch.testing.assert_close(solve_refrax(*case, method="companion"), solve_refrax(*case), rtol=1e-8, atol=0.0)


@pytest.mark.parametrize("method", ["halley", "newton"])
def test_single_precision_is_as_good_as_the_conditioning_of_the_problem(draw, method):
    case = [value.float() for value in _cases(draw, 20_000)[0]]
    exact_case = [value.double().requires_grad_() for value in case]
    exact = solve_refrax(*exact_case)
    slopes = torch.autograd.grad(exact.sum(), exact_case)
    condition = 1.0 + sum((x * slope / exact).abs() for x, slope in zip(exact_case, slopes, strict=True))

    error = ((solve_refrax(*case, method=method) - exact) / exact).abs()

    assert (error / condition).max() < 4.0 * torch.finfo(torch.float32).eps


@pytest.mark.parametrize("method", ["halley", "newton"])
def test_single_precision_reaches_a_millionth_for_a_camera_over_water(draw, method):
    case = [value.float() for value in _cases(draw, 20_000, decades=1.0, max_deg=75.0, max_index=1.6)[0]]

    exact = solve_refrax(*(value.double() for value in case))

    torch.testing.assert_close(solve_refrax(*case, method=method).double(), exact, rtol=1e-6, atol=0.0)


def test_every_start_is_a_lower_bound_so_that_newton_climbs_monotonically(draw):
    (height, depth, distance, index), truth = _cases(draw, 20_000)
    root = truth / height

    start = lower_bound(Equation(distance.square(), height, (depth,), (index,)))

    assert (start > 0).all()
    assert (start <= root * (1.0 + 4.0 * torch.finfo(torch.float64).eps)).all()


@pytest.mark.parametrize("method", METHODS)
def test_snells_law_holds_at_the_refrax(draw, method):
    (height, depth, distance, index), _ = _cases(draw, 2000, decades=1.0)

    ratio = solve_refrax(height, depth, distance, index, method=method)

    in_air, in_water = ratio * distance, (1.0 - ratio) * distance
    sine_air, sine_water = in_air / torch.hypot(in_air, height), in_water / torch.hypot(in_water, depth)
    torch.testing.assert_close(sine_air, index * sine_water, rtol=1e-8 if method == "companion" else 1e-11, atol=0.0)


@pytest.mark.parametrize("method", METHODS)
def test_at_nadir_the_depth_is_divided_by_the_index_ratio(draw, method):
    height, depth, index = draw.power_of_ten(-1, 1, 100), draw.power_of_ten(-1, 1, 100), draw.uniform(1.0, 2.5, 100)

    assert_matches(solve_refrax(height, depth, 0.0, index, method=method), height / (height + depth / index))


@pytest.mark.parametrize("method", METHODS)
def test_at_index_ratio_one_the_ray_is_straight(draw, method):
    (height, depth, distance, _), _ = _cases(draw, 100, decades=1.0)

    ratio = solve_refrax(height, depth, distance, 1.0, method=method)

    torch.testing.assert_close(
        ratio, height / (height + depth), rtol=1e-6 if method == "companion" else EXACT.rounding, atol=0.0
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_point_on_the_surface_is_its_own_refrax(draw, method):
    (height, _, distance, index), _ = _cases(draw, 100)

    assert_matches(solve_refrax(height, 0.0, distance, index, method=method), torch.ones_like(height))


def test_the_unit_of_length_does_not_matter_to_the_last_bit(draw):
    (height, depth, distance, index), _ = _cases(draw, 1000)

    in_other_unit = solve_refrax(1024.0 * height, 1024.0 * depth, 1024.0 * distance, index)

    assert torch.equal(in_other_unit, solve_refrax(height, depth, distance, index))


def test_denser_water_moves_the_refrax_towards_the_point(draw):
    (height, depth, distance, index), _ = _cases(draw, 1000, decades=1.0)

    assert (solve_refrax(height, depth, distance, index + 0.01) > solve_refrax(height, depth, distance, index)).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_arguments_broadcast_and_numbers_take_the_dtype_of_the_tensors(draw, dtype):
    height, distance = draw.uniform(1.0, 2.0, 3, 1).to(dtype), draw.uniform(0.0, 5.0, 4).to(dtype)

    ratio = solve_refrax(height, 0.7, distance, 1.333)

    assert ratio.shape == (3, 4)
    assert ratio.dtype == dtype
    assert_matches(ratio[1, 2], solve_refrax(height[1, 0], 0.7, distance[2], 1.333))


def test_numbers_alone_are_solved_in_double_precision():
    ratio = solve_refrax(1.0, 1.0, 2.0, 1.333)

    assert ratio.dtype == torch.float64
    assert_matches(ratio, torch.tensor(_refrax_by_bracketing(1.0, 1.0, 2.0, 1.333), dtype=torch.float64))


def _cases(draw, count, *, decades=3.0, max_deg=89.9, max_index=2.5, nearly_one=False):
    """Random cases and their true refrax ratios; `decades` bounds depth/height on either side of 1."""
    height = draw.power_of_ten(-2.0, 2.0, count)
    depth = height * draw.power_of_ten(-decades, decades, count)
    above_one = draw.power_of_ten(-12.0, -2.0, count) if nearly_one else draw.uniform(0.01, max_index - 1.0, count)
    index = 1.0 + above_one
    tangent = torch.deg2rad(draw.uniform(0.01, max_deg, count)).tan()
    in_air = height * tangent
    in_water = depth * tangent / (index.square() + (index - 1.0) * (index + 1.0) * tangent.square()).sqrt()
    distance = in_air + in_water
    return (height, depth, distance, index), in_air / distance


def _many_cases(draw, dtype):
    """240 000 cases, rounded to `dtype`: index ratios from 1 on, evenly or on a logarithmic scale; angles up to 89.9
    degrees, evenly or with their tangent on a logarithmic scale."""
    height = draw.power_of_ten(-1.0, 1.0, 2, 2, 60_000)
    depth = height * draw.power_of_ten(-3.0, 3.0, 2, 2, 60_000)
    even, nearly_one = draw.uniform(0.0, 1.5, 2, 60_000), 1.5 * draw.power_of_ten(-16.0, 0.0, 2, 60_000)
    index = 1.0 + torch.stack((even, nearly_one), dim=1)
    steepest = math.radians(89.9)
    by_angle = draw.uniform(0.0, steepest, 2, 60_000).tan()
    by_tangent = math.tan(steepest) * draw.power_of_ten(-5.0, 0.0, 2, 60_000)
    tangent = torch.stack((by_angle, by_tangent))
    in_water = depth * tangent / (index.square() + (index - 1.0) * (index + 1.0) * tangent.square()).sqrt()
    return tuple(value.flatten().to(dtype) for value in (height, depth, height * tangent + in_water, index))


def _in_extended_precision(height, depth, distance, index):
    """Newton from a lower bound on s = ratio / height, which climbs to s (h + d w) = 1 and stays."""
    h, d, a, n = map(_extended, (height, depth, distance, index))
    n_sq, excess = n * n, (n - 1.0) * (n + 1.0) * a * a
    with np.errstate(divide="ignore"):
        grazing = (1.0 - d / np.sqrt(excess)) / h
    s = np.maximum(1.0 / (h + d / n), np.where(excess > 0.0, grazing, 0.0))
    for _ in range(25):
        w = 1.0 / np.sqrt(n_sq + excess * s * s)
        s = s - (s * (h + d * w) - 1.0) / (h + d * n_sq * w**3)
    return s * h


def _extended(value):
    return value.numpy().astype(np.longdouble)


def _refrax_by_bracketing(height, depth, distance, index):
    """Root of h(t) = height t + depth t / sqrt(n^2 + (n^2 - 1) t^2) - distance, in plain Python."""

    def excess(tangent):
        return height * tangent + depth * tangent / math.hypot(index, math.sqrt(index**2 - 1.0) * tangent) - distance

    upper = distance / height
    return height * brentq(excess, 0.0, upper, xtol=1e-300, rtol=1e-15, maxiter=1000) / distance
