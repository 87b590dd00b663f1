"""What all pose solvers refuse, and that points which are all the same determine nothing."""

import math
import re

import pytest
import torch

from torchrefrac.minimal import (
    absolute_pose_2pt,
    absolute_pose_known_heading,
    absolute_pose_lsqi,
    relative_pose_3pt,
    relative_pose_4pt,
    relative_pose_7pt,
    relative_pose_npt,
)

WATER = 1.33
EXACT = {relative_pose_3pt: 3, relative_pose_4pt: 4, relative_pose_7pt: 7, absolute_pose_2pt: 2}
AT_LEAST = {relative_pose_npt: 7, absolute_pose_lsqi: 3, absolute_pose_known_heading: 2}
SAMPLES = EXACT | AT_LEAST
WITH_HEADING = (relative_pose_3pt, absolute_pose_known_heading)


def _names(solve):
    return ("rays1", "rays2") if "relative" in solve.__name__ else ("rays", "points")


def _call(solve, first, second, index_ratio=WATER, heading=0.1, **more):
    return solve(first, second, *((heading,) if solve in WITH_HEADING else ()), index_ratio, **more)


@pytest.fixture
def make_data(make_pair, make_view):
    """`make_data(solve, count)`: what the solver takes, for five problems."""

    def make(solve, count):
        return (make_pair if "relative" in solve.__name__ else make_view)(5, points=count)[:2]

    return make


@pytest.mark.parametrize("solve", SAMPLES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("argument", [0, 1])
def test_numbers_that_are_not_finite_are_refused_by_name(make_data, solve, bad, argument):
    data = make_data(solve, SAMPLES[solve])
    data[argument][3, 1, 2] = bad

    with pytest.raises(ValueError, match=f"^{_names(solve)[argument]} is {bad:g} somewhere, but must be finite$"):
        _call(solve, *data)


@pytest.mark.parametrize("solve", SAMPLES)
def test_shapes_that_differ_are_refused_by_name(solve):
    count = SAMPLES[solve]
    name, other = _names(solve)

    for first, second in (((count, 3), (count + 1, 3)), ((count, 3), (2, count, 3)), ((count, 2),) * 2, ((3,),) * 2):
        wanted = f"(*B, {count if solve in EXACT else 'n'}, 3)"
        message = f"{name} {first} and {other} {second} must both be {wanted}"
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            _call(solve, torch.ones(first), torch.ones(second))


@pytest.mark.parametrize("solve", SAMPLES)
def test_fewer_points_than_the_sample_are_refused_by_name(solve):
    given = SAMPLES[solve] - 1

    with pytest.raises(
        ValueError, match=rf"^{_names(solve)[0]} has {given} rays, but .* (needs at least|takes exactly)"
    ):
        _call(solve, torch.ones(5, given, 3), torch.ones(5, given, 3))


@pytest.mark.parametrize("solve", EXACT)
def test_more_points_than_an_exact_sample_are_refused_by_name(solve):
    with pytest.raises(ValueError, match=rf"the {EXACT[solve]}-point solver takes exactly {EXACT[solve]}$"):
        _call(solve, torch.ones(EXACT[solve] + 1, 3), torch.ones(EXACT[solve] + 1, 3))


@pytest.mark.parametrize("solve", SAMPLES)
def test_whole_numbers_are_refused_by_name(solve):
    whole = torch.ones(SAMPLES[solve], 3, dtype=torch.int64)

    with pytest.raises(ValueError, match=f"^{_names(solve)[0]} has dtype torch.int64"):
        _call(solve, whole, whole)


@pytest.mark.parametrize("solve", SAMPLES)
def test_an_index_ratio_below_one_is_refused(make_data, solve):
    with pytest.raises(ValueError, match=r"^index_ratio is 0\.9, but must be finite and at least 1$"):
        _call(solve, *make_data(solve, SAMPLES[solve]), index_ratio=0.9)


@pytest.mark.parametrize("solve", [solve for solve in SAMPLES if "relative" in solve.__name__])
def test_a_height_that_is_not_above_the_water_is_refused(make_data, solve):
    with pytest.raises(ValueError, match=r"^height is 0, but must be finite and above 0$"):
        _call(solve, *make_data(solve, SAMPLES[solve]), height=0.0)


@pytest.mark.parametrize("solve", AT_LEAST)
def test_weights_that_are_not_one_a_ray_or_negative_are_refused(make_data, solve):
    data = make_data(solve, 8)

    with pytest.raises(ValueError, match=r"^weights has shape \(5, 7\), but must be \(5, 8\), one a ray$"):
        _call(solve, *data, weights=torch.ones(5, 7))
    with pytest.raises(ValueError, match=r"^weights is -1 somewhere, but must be finite and at least 0$"):
        _call(solve, *data, weights=-torch.ones(5, 8))


@pytest.mark.parametrize("solve", WITH_HEADING)
def test_a_heading_that_is_not_one_a_problem_is_refused(make_data, solve):
    data = make_data(solve, SAMPLES[solve])

    with pytest.raises(ValueError, match=r"^shapes do not broadcast: heading \(4,\), rays \(5,\)$"):
        _call(solve, *data, heading=torch.ones(4))
    with pytest.raises(ValueError, match=r"^heading is nan, but must be finite$"):
        _call(solve, *data, heading=math.nan)


@pytest.mark.parametrize("solve", SAMPLES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("more", [0, 3])
def test_one_point_many_times_gives_no_valid_pose_and_finite_numbers(make_data, draw, solve, dtype, more):
    count = SAMPLES[solve] + (more if solve in AT_LEAST else 0)
    first, second = (part[:, :1].expand(5, count, 3) for part in make_data(solve, SAMPLES[solve]))
    first = first * draw.power_of_ten(-2.0, 2.0, 5, count, 1)

    *pose, valid = _call(solve, first.to(dtype), second.to(dtype))

    assert not valid.any()
    assert all(part.isfinite().all() for part in pose)


@pytest.mark.parametrize("solve", SAMPLES)
def test_no_problems_have_no_solutions(solve):
    *pose, valid = _call(solve, torch.ones(0, SAMPLES[solve], 3), torch.ones(0, SAMPLES[solve], 3))

    assert valid.shape[0] == 0
    assert all(part.shape[0] == 0 for part in pose)
