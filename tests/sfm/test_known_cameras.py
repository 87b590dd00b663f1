"""Points of tracks that were made elsewhere, through cameras that are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from torchrefrac import Interfaces, Observations, Rigid, Scene, triangulate_tracks
from torchrefrac.geometry import Similarity, so3_exp
from torchrefrac.scene import SceneError
from torchrefrac.sfm.frame import transformed

WATER = 1.333


@pytest.fixture
def make_tracks(make_basin, draw):
    """`make_tracks(points, cameras, noise=0.3)`: a scene without points, its cameras' observations of points, and where
    these are; every `land`-th from the first lies on land."""

    def make(points, cameras, noise=0.3, land=0):
        basin = make_basin(cameras=cameras, points=points, land=land, index_ratio=WATER)
        pixels, _ = basin.project()
        pixels = pixels + noise * draw.normal(*pixels.shape)
        view = torch.arange(cameras).repeat_interleave(points)
        seen = Observations(view, torch.arange(points).repeat(cameras), pixels.flatten(0, 1))
        pose, nothing = Rigid(basin.rotation, basin.center), Observations.none()
        return Scene.create(pose, basin.lens, Interfaces.level(WATER), basin.points[:0], nothing), seen, basin.points

    return make


@pytest.mark.parametrize(("cameras", "points"), [(2, 30), (4, 20)])
def test_points_are_those_of_a_scalar_gauss_newton_loop_by_fermat_s_principle(make_tracks, cameras, points):
    scene, seen, _ = make_tracks(points, cameras)

    found, used = triangulate_tracks(scene, seen)

    assert found.valid.all()
    assert used.all()
    pixels = seen.pixels.unflatten(0, (cameras, points)).numpy()
    lens = float(scene.intrinsics.focal[0]), scene.intrinsics.principal_point.numpy()
    rotation, center = scene.views.rotation.numpy(), scene.views.center.numpy()
    for i, start in enumerate(found.points.numpy()):

        def residuals(point, i=i):
            projected = [_project(point, *pose, *lens) for pose in zip(rotation, center, strict=True)]
            return (np.array(projected) - pixels[:, i]).ravel()

        best = start + 0.1
        for _ in range(8):
            slopes = [(residuals(best + step) - residuals(best - step)) / 2e-3 for step in 1e-3 * np.eye(3)]
            best = best - np.linalg.lstsq(np.stack(slopes, axis=-1), residuals(best), rcond=None)[0]
        assert np.linalg.norm(best - start) < 1e-9 * abs(start[2])
        assert float(found.rms[i]) == pytest.approx(np.sqrt((residuals(best) ** 2).sum() / cameras), rel=1e-8)


def test_covariances_are_those_of_the_scatter(make_tracks):
    scene, seen, points = make_tracks(2000, 3, noise=0.5)

    found, _ = triangulate_tracks(scene, seen, pixel_sigma=0.5)

    off = found.points - points
    normal = (off[:, None] @ torch.linalg.inv(found.covariance) @ off[..., None])[:, 0, 0]
    assert normal.mean() == pytest.approx(3.0, rel=0.1)


def test_land_and_water_are_placed_together(make_tracks):
    scene, seen, points = make_tracks(12, 2, noise=0.0, land=4)

    found, _ = triangulate_tracks(scene, seen)

    assert (points[:4, 2] > 0.0).all()
    torch.testing.assert_close(found.points, points, rtol=1e-8, atol=1e-8)


def test_the_surface_may_be_any_plane(make_tracks, draw):
    scene, seen, points = make_tracks(20, 3, noise=0.0)
    change = Similarity(draw.uniform(0.5, 2.0), so3_exp(draw.normal(3)), 10.0 * draw.normal(3))
    normal = change.rotation[:, 2][None]
    surface = Interfaces(normal, normal @ change.translation, scene.interfaces.index_ratio)

    found, _ = triangulate_tracks(replace(transformed(scene, change), interfaces=surface), seen)

    assert found.valid.all()
    torch.testing.assert_close(found.points, change.apply(points), rtol=1e-8, atol=1e-7)


@pytest.mark.parametrize("wrong", [1, 2])
def test_observations_that_contradict_the_others_are_set_aside(make_tracks, wrong):
    scene, seen, _ = make_tracks(20, 6)
    at = torch.isin(seen.view, torch.arange(wrong)) & (seen.point % 2 == 0)
    off = 40.0 * torch.tensor([1.0, -1.0], dtype=torch.float64)

    found, used = triangulate_tracks(scene, replace(seen, pixels=seen.pixels + at[:, None] * off))

    assert torch.equal(used, ~at)
    expected, _ = triangulate_tracks(scene, seen[~at])
    torch.testing.assert_close(found.points, expected.points, rtol=1e-9, atol=1e-9)
    assert torch.equal(found.num_views, torch.bincount(seen.point[~at]))


def test_what_two_views_contradict_or_one_view_sees_is_not_valid(make_tracks):
    scene, seen, _ = make_tracks(10, 2)
    moved = seen.pixels.clone()
    moved[3] += torch.tensor([-100.0, 80.0], dtype=torch.float64)
    rows = torch.arange(20) != 7

    found, used = triangulate_tracks(scene, replace(seen, pixels=moved)[rows])

    assert (~found.valid).nonzero()[:, 0].tolist() == [3, 7]
    assert not used[torch.isin(seen.point[rows], torch.tensor([3, 7]))].any()


def test_the_order_of_observations_does_not_matter(make_tracks, draw):
    scene, seen, _ = make_tracks(20, 3)
    order = draw.uniform(0.0, 1.0, 60).argsort()

    mixed, _ = triangulate_tracks(scene, seen[order])

    expected, _ = triangulate_tracks(scene, seen)
    torch.testing.assert_close(mixed.points, expected.points, rtol=1e-9, atol=1e-9)


def test_no_observations_make_no_points(make_tracks):
    scene, seen, _ = make_tracks(3, 2)

    found, used = triangulate_tracks(scene, seen[:0])

    assert len(found.points) == len(used) == 0


def test_views_that_the_scene_lacks_and_numbers_that_cannot_be_are_refused(make_tracks):
    scene, seen, _ = make_tracks(3, 2)

    with pytest.raises(SceneError, match="view runs from 2 to 3, but must lie in 0 to 1"):
        triangulate_tracks(scene, replace(seen, view=seen.view + 2))
    with pytest.raises(ValueError, match="max_error is 0, but must be finite and above 0"):
        triangulate_tracks(scene, seen, max_error=0.0)
    with pytest.raises(ValueError, match="pixels is nan somewhere, but must be finite"):
        triangulate_tracks(scene, replace(seen, pixels=seen.pixels * torch.nan))


def _project(point, rotation, center, focal, principal_point):
    """By the place on the water through which light takes the least time."""
    across = point[:2] - center[:2]
    distance, height, depth = np.hypot(*across), center[2], -point[2]

    def slower_farther_out(r):
        return r / np.hypot(r, height) - WATER * (distance - r) / np.hypot(distance - r, depth)

    r = brentq(slower_farther_out, 0.0, distance, xtol=1e-15, rtol=np.float64(1e-15))
    x, y, z = rotation @ np.append(across / distance * r, -height)
    return focal * np.array([x, y]) / z + principal_point
