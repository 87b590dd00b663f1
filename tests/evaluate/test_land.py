"""Points on land in two reconstructions, matched by what they are seen at."""

from dataclasses import replace

import pytest
import torch

from tests.files.two_cameras import two_camera_scene
from torchrefrac.evaluate.land import common_points, land_difference
from torchrefrac.scene import Assessment, Interfaces, Observations

COUNT = 12


@pytest.fixture
def scene(draw):
    """Twelve points, each seen by two views; the first seven on land."""
    points = draw.uniform(-1.0, 1.0, COUNT, 3)
    points[:7, 2], points[7:, 2] = 0.5, -0.5
    point = torch.arange(COUNT).repeat_interleave(2)
    seen = Observations(torch.arange(2).repeat(COUNT), point, draw.uniform(0.0, 100.0, 2 * COUNT, 2))
    planted = two_camera_scene(draw).with_points(points, torch.zeros(COUNT, 3, dtype=torch.uint8), seen)
    return replace(planted, length_unit="m", assessment=Assessment(lowered_by=430.0))


def _in_air(scene, moved):
    """The same without refraction, in the frame of the positions itself, its points in another order and moved."""
    order = torch.arange(COUNT - 1, -1, -1)
    pixels = scene.observations.pixels.view(COUNT, 2, 2)[order].reshape(-1, 2)
    seen = replace(scene.observations, pixels=pixels)
    points = scene.points[order] + torch.tensor((0.0, 0.0, 430.0)) + moved
    return replace(
        scene, points=points, observations=seen, interfaces=Interfaces.level(1.0), assessment=Assessment(lowered_by=0.0)
    )


def test_points_with_a_pixel_in_common_are_the_same(scene):
    ours, theirs = common_points(scene, _in_air(scene, torch.zeros(3).double()))

    assert sorted(zip(ours.tolist(), theirs.tolist(), strict=True)) == [(i, COUNT - 1 - i) for i in range(COUNT)]


def test_land_that_stays_differs_by_nothing_and_moved_land_by_how_far(scene):
    moved = torch.zeros(COUNT, 3, dtype=torch.float64)
    moved[:5] = 9.0  # what lies under water does not count
    still = land_difference(scene, _in_air(scene, moved))
    shifted = land_difference(scene, _in_air(scene, moved + torch.tensor((0.03, 0.0, -0.04)).double()))

    assert still["land_points_compared"] == 7
    assert still["land_difference_rms_m"] == pytest.approx(0.0, abs=1e-9)
    assert shifted["land_difference_median_m"] == pytest.approx(0.05, abs=1e-7)
    assert shifted["land_rise_median_m"] == pytest.approx(0.04, abs=1e-7)


def test_other_photographs_are_no_comparison(scene):
    air = _in_air(scene, torch.zeros(3).double())
    others = tuple(f"other{name}" for name in air.views.names)

    assert land_difference(scene, replace(air, views=replace(air.views, names=others))) == {}
