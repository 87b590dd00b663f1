"""Poses of cameras that look into water through glass."""

import math
import re
from dataclasses import replace

import pytest
import torch

from tests.minimal.pose_errors import HEIGHT, WATER, absolute_error, relative_error
from torchrefrac.minimal import (
    Layers,
    absolute_pose_2pt,
    absolute_pose_known_heading,
    absolute_pose_lsqi,
    relative_pose_3pt,
    relative_pose_4pt,
    relative_pose_7pt,
    relative_pose_npt,
)
from torchrefrac.minimal.rays import bent
from torchrefrac.refraction.interface import GLASS

RELATIVE = {relative_pose_4pt: 4, relative_pose_7pt: 7, relative_pose_npt: 12, relative_pose_3pt: 3}
ABSOLUTE = {absolute_pose_2pt: 2, absolute_pose_lsqi: 6, absolute_pose_known_heading: 3}
SOLVERS = RELATIVE | ABSOLUTE
WITH_HEADING = (relative_pose_3pt, absolute_pose_known_heading)
HEIGHTS = (HEIGHT, 60.0)
THIN, THICK = 1.2, 8.0


def test_behind_layers_a_ray_goes_on_as_one_of_a_camera_that_stands_higher():
    index, thickness, height, depth = (1.49, 1.52, 1.0), (0.4, 1.2, 0.7), 30.0, 50.0
    for angle in (0.0, 0.1, 0.7, 1.3):
        # Snell's law of the sines, layer by layer down to the depth.
        way = height * math.tan(angle)
        for n, t in (*zip(index, thickness, strict=True), (WATER, depth - sum(thickness))):
            way += t * math.tan(math.asin(math.sin(angle) / n))

        ray = torch.tensor([[math.sin(angle), 0.0, -math.cos(angle)]], dtype=torch.float64)
        (m, w, lift) = bent(ray, WATER, _layers(thickness, index))

        assert float(-(height + lift) * m[..., 0] - depth * w[..., 0]) == pytest.approx(way, rel=1e-14, abs=1e-14)


@pytest.mark.parametrize("glass", [THIN, THICK])
@pytest.mark.parametrize("solve", SOLVERS)
def test_the_truth_is_among_the_candidates_in_999_problems_of_1000(make_problem, solve, glass):
    error = _error(make_problem(solve, 1000, glass), solve, _layers((glass,)))

    assert (error < 1e-8).double().mean() >= 0.999


@pytest.mark.parametrize("solve", [relative_pose_4pt, relative_pose_npt, absolute_pose_2pt, absolute_pose_lsqi])
def test_with_noise_poses_through_glass_are_as_good_as_without_it(make_problem, solve):
    behind = make_problem(solve, 200, THIN)
    through = _error(behind, solve, _layers((THIN,)), noise=0.3)
    without = _error(replace(behind, glass=0.0), solve, None, noise=0.3)
    assert through.median() < 1.05 * without.median()


@pytest.mark.parametrize("solve", [relative_pose_4pt, relative_pose_npt, absolute_pose_2pt, absolute_pose_lsqi])
def test_glass_that_is_left_out_moves_the_camera(make_problem, solve):
    error = _error(make_problem(solve, 200, THIN), solve, None)

    assert error.median() > 1e-3


@pytest.mark.parametrize("solve", SOLVERS)
def test_layers_of_water_and_layers_without_thickness_change_nothing(make_problem, solve):
    problem = make_problem(solve, 20, 0.0)

    for layers in (_layers((3.0, 5.0), (WATER, WATER)), _layers((0.0,))):
        assert _error(problem, solve, layers).amax() < 1e-8


@pytest.mark.parametrize("solve", [relative_pose_3pt, relative_pose_4pt, relative_pose_7pt])
def test_points_that_would_be_among_the_layers_make_a_candidate_invalid(make_problem, solve):
    problem = make_problem(solve, 50, 0.0)
    shallow, deep = (_error(problem, solve, _layers((thickness,), (WATER,))) for thickness in (39.0, 99.9))

    assert (shallow < 1e-8).all()
    assert (deep > 1e-8).all()


@pytest.mark.parametrize("solve", RELATIVE)
def test_height_and_thickness_together_set_the_scale(make_problem, draw, solve):
    data = _data(make_problem(solve, 20, THIN), solve)
    scale = draw.uniform(0.1, 50.0, 20)
    *_, center, valid = _call(solve, data, _layers((THIN,)))

    layers = Layers(torch.full((20, 1), GLASS, dtype=torch.float64), THIN * scale[:, None])
    *_, scaled, scaled_valid = _call(solve, data, layers, height=HEIGHT * scale)

    assert torch.equal(scaled_valid, valid)
    expected = center * scale.reshape(20, *(1,) * (center.dim() - 1))
    torch.testing.assert_close(scaled[valid], expected[valid], rtol=1e-6, atol=1e-6)


def test_a_point_on_land_is_seen_past_the_glass_and_one_among_the_layers_as_if_in_water(make_view, make_basin):
    rays, points, heading, _ = make_view(50, points=6, land=6)
    for solve in ABSOLUTE:
        data = rays[:, : ABSOLUTE[solve]], points[:, : ABSOLUTE[solve]], heading
        dry, plain = _call(solve, data, _layers((THIN,))), _call(solve, data, None)
        assert all(torch.equal(found, wanted) for found, wanted in zip(dry, plain, strict=True))

    basin = make_basin(20, cameras=1, points=6)
    data = basin.level_rays()[:, 0], basin.points, basin.heading[:, 0]
    found = _call(absolute_pose_lsqi, data, _layers((90.0,), (WATER,)))
    assert absolute_error(found[0], found[1], basin.heading[:, 0], basin.center[:, 0]).amax() < 1e-9


@pytest.mark.parametrize("solve", SOLVERS)
def test_single_precision_stays_single(make_problem, solve):
    data = (part.float() for part in _data(make_problem(solve, 5, THIN), solve))

    *pose, valid = _call(solve, data, _layers((THIN,)))

    assert all(part.dtype == torch.float32 for part in pose)
    assert valid.any()


@pytest.mark.parametrize("solve", SOLVERS)
def test_layers_that_cannot_be_are_refused_by_name(make_problem, solve):
    data = list(_data(make_problem(solve, 5, 0.0), solve))
    one, scalar = torch.ones(1), torch.tensor(1.0)

    for layers, message in (
        (Layers(0.9 * one, one), "layers.index is 0.9 somewhere, but must be finite and at least 1"),
        (Layers(one, -one), "layers.thickness is -1 somewhere, but must be finite and at least 0"),
        (Layers(math.nan * one, one), "layers.index is nan somewhere, but must be finite and at least 1"),
        (Layers(one.long(), one), "layers.index has dtype torch.int64, but must be a floating-point tensor"),
        (Layers(scalar, one), "layers.index has shape (), but must be (*B, k), one number a layer"),
        (Layers(one, torch.ones(2)), "layers.thickness has length 2, but must have 1, that of layers.index"),
        (
            Layers(torch.ones(4, 1), one),
            "shapes do not broadcast: layers.index (4,), layers.thickness (), rays (5,)",
        ),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            _call(solve, data, layers)


@pytest.fixture
def make_problem(make_basin):
    """`make_problem(solve, count, glass)`: basins with what the solver takes, seen through glass of that thickness."""

    def make(solve, count, glass):
        cameras = 2 if solve in RELATIVE else 1
        return make_basin(count, cameras=cameras, points=SOLVERS[solve], heights=HEIGHTS, glass=glass)

    return make


def _layers(thickness, index=(GLASS,)):
    return Layers(*(torch.tensor(values, dtype=torch.float64) for values in (index, thickness)))


def _data(basin, solve, noise=0.0):
    """Rays of both cameras, or rays and points, and the heading."""
    rays = basin.level_rays()
    if noise:
        pixels, _ = basin.project()
        generator = torch.Generator().manual_seed(5)
        rays = basin.level_rays_of(pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64))
    if solve in RELATIVE:
        return *rays.unbind(dim=-3), basin.second_from_first()[0]
    return rays[..., 0, :, :], basin.points, basin.heading[..., 0]


def _call(solve, data, layers, height=HEIGHT):
    first, second, heading = data
    arguments = (first, second, *((heading,) if solve in WITH_HEADING else ()), WATER)
    return solve(*arguments, *((height,) if solve in RELATIVE else ()), layers=layers)


def _error(basin, solve, layers, noise=0.0):
    """Of the valid candidate (*B) that is nearest to the truth."""
    *pose, valid = _call(solve, _data(basin, solve, noise), layers)
    relative, alone = solve in RELATIVE, (basin.heading[..., 0], basin.center[..., 0, :])
    heading, center = basin.second_from_first() if relative else alone
    count, given = len(heading), heading if solve in WITH_HEADING else pose[0]
    found = given.reshape(count, -1), pose[-1].reshape(count, -1, 3)
    error = (relative_error if relative else absolute_error)(*found, heading[:, None], center[:, None])
    return torch.where(valid.reshape(count, -1), error, torch.inf).amin(dim=-1)
