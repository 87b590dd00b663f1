"""What dense points have in common with the tie points about them, against a loop over the nearest of these."""

from dataclasses import replace

import pytest
import torch

from tests.files.two_cameras import two_camera_scene
from torchrefrac.dense.common_errors import common_deviations
from torchrefrac.scene import Assessment, Observations

EYE = torch.eye(3, dtype=torch.float64)


@pytest.fixture
def scene(draw):
    """Forty tie points, whose common errors grow with x."""
    points = draw.uniform(-1.0, 1.0, 40, 3)
    variance = (2.0 + points[:, 0])[:, None, None]
    flat = torch.diag(torch.tensor((0.1, 0.2, 1.0), dtype=torch.float64))
    known = Assessment(point_covariance=EYE + variance * flat, relative_covariance=EYE.expand(40, 3, 3))
    colors = torch.zeros(40, 3, dtype=torch.uint8)
    return replace(two_camera_scene(draw).with_points(points, colors, Observations.none()), assessment=known)


def test_it_is_the_mean_of_the_nearest_tie_points(scene, draw):
    places = draw.uniform(-1.0, 1.0, 10, 3)

    found = common_deviations(places, scene)

    for place, sigma, along in zip(places, found.largest.tolist(), found.along.tolist(), strict=True):
        nearest = (scene.points - place).norm(dim=1).argsort()[:8]
        variance = float((2.0 + scene.points[nearest, 0]).mean())
        assert sigma**2 == pytest.approx(variance)
        assert [one**2 for one in along] == pytest.approx([0.1 * variance, 0.2 * variance, variance])


def test_where_nothing_is_known_it_is_nothing(scene, draw):
    places = draw.normal(5, 3)

    assert common_deviations(places, replace(scene, assessment=Assessment())).largest.tolist() == [0.0] * 5
    assert common_deviations(places[:0], scene).along.shape == (0, 3)
