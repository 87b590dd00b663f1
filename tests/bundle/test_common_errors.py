"""Errors that neighbouring observations have in common: slopes of the surface against a plane that is tilted, fields
against their mean squares, and planted waves, which must be seen, measured and counted."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.bundle import adjust_pose, uncertainty
from torchrefrac.bundle.common_errors import _explained
from torchrefrac.bundle.random_fields import random_gradient, random_shift
from torchrefrac.bundle.surface_slope import surface_slope
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface
from torchrefrac.synthetic.options import WaveOptions
from torchrefrac.synthetic.waves import Waves

LONGEST = 60.0


def test_slopes_move_pixels_as_a_plane_that_is_tilted_about_the_place(plant):
    planted = plant(views=4, points=30)
    scene, seen = planted.truth, planted.observations
    found = surface_slope(scene, seen)
    step = 1e-6
    camera = scene.camera_of(seen.view)

    for axis in (0, 1):
        slope = torch.zeros(2, dtype=torch.float64)
        slope[axis] = step
        pixels = []
        for sign in (1.0, -1.0):
            normal = torch.cat((-sign * slope, torch.ones(1, dtype=torch.float64))).expand(len(seen), 3)
            normal = torch.nn.functional.normalize(normal, dim=-1)
            offset = (normal[:, :2] * found.place).sum(dim=-1)  # through the place, whose height is zero
            tilted = FlatInterface(scene.index_ratio, plane=Plane(normal, offset, check=False), check=False)
            bent = RefractiveCamera(
                camera.intrinsics, camera.cam_from_world_rotation, camera.center_in_world, tilted, check=False
            )
            pixels.append(bent.project(scene.points[seen.point])[0])
        expected = (pixels[0] - pixels[1]) / (2.0 * step)
        torch.testing.assert_close(found.by_slope[:, :, axis], expected, rtol=1e-5, atol=1e-4)


def test_places_are_where_the_rays_meet_the_surface_and_dry_points_do_not_notice_it(plant):
    planted = plant(views=4, points=30)
    points = planted.truth.points.clone()
    points[:5, 2] = 0.5
    scene, seen = replace(planted.truth, points=points), planted.observations

    found = surface_slope(scene, seen)

    dry = seen.point < 5
    assert (found.by_slope[dry] == 0.0).all()
    assert (found.by_slope[~dry] != 0.0).any(dim=(1, 2)).all()
    camera = scene.camera_of(seen.view)
    origins, _, _ = camera.cast_rays(camera.project(points[seen.point])[0])
    torch.testing.assert_close(found.place[~dry], origins[~dry, :2])


@pytest.mark.parametrize("field", [random_gradient, random_shift])
def test_fields_have_a_mean_square_of_one_and_differ_from_group_to_group(field, draw, generator):
    place, group = draw.uniform(-500.0, 500.0, 2000, 2), torch.arange(2000) % 2
    twice = torch.cat((place, place)), torch.cat((group, 1 - group))

    found = torch.stack([field(*twice, 3.0, generator) for _ in range(20)])

    wanted = 1.0 if field is random_gradient else 2.0
    assert float(found.square().sum(dim=1).mean()) == pytest.approx(wanted, rel=0.05)
    here, there = found[..., :2000], found[..., 2000:]
    assert float((here * there).sum(dim=1).mean()) == pytest.approx(0.0, abs=0.05)


def test_fields_change_over_their_length(draw, generator):
    place, group = draw.uniform(-500.0, 500.0, 1500, 2), torch.zeros(1500, dtype=torch.long)
    shifts = (0.1, 1.0, 10.0)

    def alike(shift):
        moved = torch.cat((place, place + torch.tensor((shift, 0.0), dtype=torch.float64)))
        fields = (random_shift(moved, group.repeat(2), 1.0, generator) for _ in range(20))
        return sum(float((f[:, :1500] * f[:, 1500:]).mean()) for f in fields) / 20

    assert [alike(shift) for shift in shifts] == pytest.approx([math.exp(-0.5 * s * s) for s in shifts], abs=0.1)


def _rough(planted, waves, noise, draw):
    """The scene as waves would show it, to first order, with noise; and their root mean square slope where it is
    seen."""
    scene, seen = planted.truth, planted.observations
    slope = surface_slope(scene, seen)
    pixels = seen.pixels + noise * draw.normal(len(seen), 2)
    gradient = torch.zeros_like(pixels)
    for view in range(len(scene.views)):
        rows = seen.view == view
        gradient[rows] = waves.at(view).surface(slope.place[rows])[1]
    pixels += torch.einsum("kis,ks->ki", slope.by_slope, gradient)
    rms = float(gradient.square().sum(dim=1).mean().sqrt())
    return replace(planted, observations=replace(seen, pixels=pixels)), rms


@pytest.mark.parametrize("moving", [False, True])
def test_waves_are_seen_and_measured_and_deviations_take_them_in(plant, draw, moving):
    planted = plant(views=8, points=600)
    waves = Waves.draw(WaveOptions(rms_slope=0.01, longest=LONGEST, moving=moving), seed=2)
    rough, slope = _rough(planted, waves, 0.1, draw)
    report = rough.adjusted(planted.truth, terms=[planted.gravity])

    known = uncertainty(report.problem, report.scene)
    independent = uncertainty(report.problem, report.scene, known.pixel_sigma)

    assert known.common is not None
    assert slope / 1.5 < known.common.slope < slope * 1.5
    assert (known.common.moving_slope > known.common.still_slope) == moving
    assert (known.point_sigma > 0.9 * independent.point_sigma).all()
    assert float(known.pose.diagonal(dim1=1, dim2=2).sum() / independent.pose.diagonal(dim1=1, dim2=2).sum()) > 2.0


def test_independent_noise_is_not_taken_for_anything_else(plant, draw):
    planted = plant(views=8, points=600)
    seen = planted.observations
    noisy = replace(planted, observations=replace(seen, pixels=seen.pixels + 0.3 * draw.normal(len(seen), 2)))
    report = noisy.adjusted(planted.truth, terms=[planted.gravity])

    assert uncertainty(report.problem, report.scene).common is None


def test_it_is_the_same_every_time(plant, draw):
    planted = plant(views=5, points=200)
    rough, _ = _rough(planted, Waves.draw(WaveOptions(rms_slope=0.03, longest=LONGEST), seed=2), 0.1, draw)
    report = rough.adjusted(planted.truth, terms=[planted.gravity])

    first, second = (uncertainty(report.problem, report.scene) for _ in range(2))

    assert first.common is not None
    assert torch.equal(first.points, second.points)
    assert torch.equal(first.covariance, second.covariance)


def test_where_all_is_known_but_the_cameras_nothing_is_asked(plant):
    report = adjust_pose(plant(views=1, points=200, noise=0.5).truth)

    assert uncertainty(report.problem, report.scene).common is None


def test_sums_over_cells_without_a_pair_explain_nothing():
    left = torch.tensor([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]], dtype=torch.float64)
    seen, spread = (torch.tensor(v, dtype=torch.float64) for v in ((3.0, 8.0, 0.0), (1.0, 1.0, 0.0)))

    assert _explained(left, seen, spread) == pytest.approx([3.0, 4.0])
    assert _explained(left, seen, 0.0 * spread) == [0.0, 0.0]
