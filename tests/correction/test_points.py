"""Apparent points are corrected as slow scalar formulas correct them."""

import math

import numpy as np
import pytest
import torch

from tests.correction.survey import looking_down, mean_of_dietrich, met_by_rays, ring
from torchrefrac.correction import CorrectionRules, correct_points, points
from torchrefrac.refraction import FlatInterface, lift_points

N = 1.333
ORACLES = {"rays": met_by_rays, "mean": mean_of_dietrich}


def correct(given, cameras, level=0.0, **rules):
    level = torch.full_like(given[:, 2], level) if isinstance(level, float) else level
    return correct_points(given, level, torch.ones_like(level, dtype=torch.bool), cameras, CorrectionRules(**rules))


@pytest.fixture
def survey(draw):
    """A hundred apparent points below a sloping surface, and twelve cameras that all see them."""
    given = torch.cat((draw.uniform(-8.0, 8.0, 100, 2), draw.uniform(-4.0, -0.5, 100, 1)), dim=-1)
    center = torch.cat((draw.uniform(-15.0, 15.0, 12, 2), draw.uniform(28.0, 32.0, 12, 1)), dim=-1)
    return given, looking_down(center), 0.1 + 0.01 * given[:, 0]


@pytest.mark.parametrize("method", ORACLES)
def test_points_are_where_a_scalar_loop_over_cameras_puts_them(survey, method):
    given, cameras, level = survey

    found = correct(given, cameras, level, method=method)

    loop = [
        ORACLES[method](cameras.center.numpy(), point, height, N)
        for point, height in zip(given.numpy(), level.tolist(), strict=True)
    ]
    np.testing.assert_allclose(found.points.numpy(), np.array(loop), rtol=0.0, atol=1e-9)
    assert found.views.tolist() == [12] * 100
    np.testing.assert_allclose(found.depth.numpy(), (level - found.points[:, 2]).numpy(), atol=1e-12)
    np.testing.assert_allclose(found.apparent_depth.numpy(), (level - given[:, 2]).numpy(), atol=1e-12)


@pytest.mark.parametrize("method", ORACLES)
def test_a_point_that_a_ring_of_cameras_sees_is_exact(method):
    true = torch.tensor((2.0, -1.0, -3.0), dtype=torch.float64)
    center = ring(true, 9.0, 20.0)
    offset, _ = lift_points(center, true, FlatInterface(N))
    apparent = center + offset
    assert float((apparent - apparent[0]).norm(dim=-1).max()) < 1e-12

    found = correct(apparent[:1], looking_down(center), method=method)

    torch.testing.assert_close(found.points[0], true, rtol=0.0, atol=1e-9)
    assert float(found.misfit) < 1e-9
    angle = math.atan2(9.0, 20.0 - float(apparent[0, 2]))
    assert float(found.incidence) == pytest.approx(angle, abs=1e-12)


def test_with_the_true_poses_little_is_left_and_least_by_rays(draw):
    true = torch.cat((draw.uniform(-12.0, 12.0, 200, 2), draw.uniform(-4.5, -3.0, 200, 1)), dim=-1)
    grid = torch.cartesian_prod(torch.linspace(-9.0, 9.0, 4), torch.linspace(-9.0, 9.0, 3)).double()
    center = torch.cat((grid, draw.uniform(18.0, 22.0, 12, 1)), dim=-1)
    offset, _ = lift_points(center, true[:, None], FlatInterface(N))
    straight = torch.nn.functional.normalize(offset, dim=-1)
    apparent, _ = points.triangulate(center.expand_as(straight), straight)  # as an ordinary dense matching does

    left = {
        method: float((correct(apparent, looking_down(center), method=method).points - true).norm(dim=-1).mean())
        for method in ORACLES
    }

    before = float((apparent - true).norm(dim=-1).mean())
    assert left["rays"] < 0.05 * before
    assert left["rays"] < 0.5 * left["mean"]


def test_sigma_is_how_far_points_scatter_whose_rays_have_that_error(draw):
    true = torch.tensor((0.0, 0.0, -3.0), dtype=torch.float64)
    center = ring(true, 6.0, 20.0)
    apparent = center[0] + lift_points(center[:1], true, FlatInterface(N))[0][0]
    sigma_deg, count = 0.05, 4000
    found = correct(apparent[None], looking_down(center), angle_sigma_deg=sigma_deg)

    way = (apparent - center).expand(count, 6, 3)
    turned = way + math.radians(sigma_deg) * way.norm(dim=-1, keepdim=True) * draw.normal(count, 6, 3)
    entry, along, _ = points.refract_rays(center, turned, FlatInterface(N))
    met, _ = points.triangulate(entry, along, 1.0 / way.square().sum(dim=-1))
    scatter = torch.linalg.eigvalsh(met.T.cov())[-1].sqrt()

    assert float(found.sigma) == pytest.approx(float(scatter), rel=0.25)  # below the water errors of angles are smaller


def test_sigma_grows_with_the_misfit_of_the_rays(survey):
    given, cameras, level = survey

    small, large = (correct(given, cameras, level, angle_sigma_deg=sigma) for sigma in (1e-6, 1e-5))

    torch.testing.assert_close(small.sigma, large.sigma)  # the rays pass by much farther
    assert bool((small.misfit > 0.0).all())
    torch.testing.assert_close(correct(given, cameras, level, angle_sigma_deg=10.0).misfit, small.misfit)


def test_points_without_water_or_cameras_stay_to_the_last_bit(survey):
    given, cameras, level = survey
    given[::4, 2] = 1.0 / 3.0  # above the water
    given[1::4, 0] += 1e4  # where no camera looks
    given[2::4, 0] = torch.nan
    wet = torch.ones(100, dtype=torch.bool)
    wet[3::8] = False

    found = correct_points(given, level, wet, cameras, CorrectionRules())

    moved = torch.zeros(100, dtype=torch.bool)
    moved[7::8] = True
    assert torch.equal(found.corrected, moved)
    assert np.array_equal(found.points[~moved].numpy(), given[~moved].numpy(), equal_nan=True)
    assert bool(found.sigma[~moved].isinf().all())
    assert bool((found.points[moved, 2] < given[moved, 2]).all())
    assert found.below.tolist() == [bool(i % 4 == 1 or i % 8 == 7) for i in range(100)]


def test_cameras_beyond_the_limits_do_not_count(survey):
    given, cameras, level = survey
    away = (given[:, None] - cameras.center)[..., :2].norm(dim=-1)
    down = cameras.center[:, 2] - given[:, None, 2]

    by_angle = correct(given, cameras, level, max_angle_deg=20.0, min_views=3)
    by_distance = correct(given, cameras, level, max_distance=9.0, min_views=3)

    for found, seen in ((by_angle, (away / down).atan().rad2deg() <= 20.0), (by_distance, away <= 9.0)):
        count = seen.sum(dim=-1)
        assert torch.equal(found.views, torch.where(count >= 3, count, 0))
    assert 0 < int(by_angle.corrected.sum()) < 100


def test_only_cameras_whose_photographs_show_a_point_count(survey):
    given, cameras, level = survey
    narrow = looking_down(cameras.center, half=0.3)
    inside = (given[:, None] - cameras.center)[..., :2].abs() <= 0.3 * (cameras.center[:, 2] - given[:, None, 2])[
        ..., None
    ]

    found = correct(given, narrow, level)

    count = inside.all(dim=-1).sum(dim=-1)
    assert torch.equal(found.views, torch.where(count >= 2, count, 0))


@pytest.mark.parametrize("method", ORACLES)
def test_blocks_of_any_size_give_the_same(survey, monkeypatch, method):
    given, cameras, level = survey
    whole = correct(given, cameras, level, method=method, max_angle_deg=25.0)
    monkeypatch.setattr(points, "PAIRS", 40)

    parts = correct(given, cameras, level, method=method, max_angle_deg=25.0)

    assert torch.equal(parts.views, whole.views)
    torch.testing.assert_close(parts.points, whole.points, rtol=0.0, atol=1e-10)
    torch.testing.assert_close(parts.sigma, whole.sigma)


def test_far_from_the_origin_of_a_map_nothing_is_lost(survey):
    given, cameras, level = survey
    far = given.new_tensor((512_345.0, 5_123_456.0, 400.0))
    near = correct(given, cameras, level)

    moved = correct(given + far, looking_down(cameras.center + far), level + far[2])

    torch.testing.assert_close(moved.points - far, near.points, rtol=0.0, atol=1e-6)


def test_without_refraction_nothing_moves(survey):
    given, cameras, level = survey

    for method in ORACLES:
        found = correct(given, cameras, level, method=method, index_ratio=1.0)
        torch.testing.assert_close(found.points, given, rtol=0.0, atol=1e-9)


def test_rules_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="min_views is 1, but rays meet where there are 2 or more"):
        CorrectionRules(min_views=1)
    with pytest.raises(ValueError, match=r"index_ratio is 0\.75"):
        CorrectionRules(index_ratio=0.75)
