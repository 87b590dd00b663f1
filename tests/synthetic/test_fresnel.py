"""Reflectance of water: against the textbook at its landmarks."""

import math

import pytest
import torch

from torchrefrac.synthetic.waves import reflectance


@pytest.mark.parametrize("n", [1.2, 1.333, 1.5])
def test_straight_down_it_is_that_of_the_textbook(n):
    assert float(reflectance(torch.tensor(1.0, dtype=torch.float64), n)) == pytest.approx(
        ((n - 1) / (n + 1)) ** 2, rel=1e-12
    )


@pytest.mark.parametrize("n", [1.2, 1.333, 1.5])
def test_at_brewsters_angle_only_one_polarisation_is_mirrored(n):
    brewster = math.atan(n)
    in_water = math.pi / 2 - brewster
    across = (math.sin(brewster - in_water) / math.sin(brewster + in_water)) ** 2

    mirrored = reflectance(torch.tensor(math.cos(brewster), dtype=torch.float64), n)

    assert float(mirrored) == pytest.approx(across / 2, rel=1e-12)


def test_between_them_it_follows_the_formulas_of_sines_and_tangents():
    angle = torch.linspace(0.05, 1.5, 50, dtype=torch.float64)
    in_water = (angle.sin() / 1.333).asin()
    across = ((angle - in_water).sin() / (angle + in_water).sin()).square()
    along = ((angle - in_water).tan() / (angle + in_water).tan()).square()

    assert torch.allclose(reflectance(angle.cos(), 1.333), (across + along) / 2)


def test_a_level_ray_is_mirrored_whole_and_one_without_an_interface_passes_whole():
    assert float(reflectance(torch.tensor(0.0, dtype=torch.float64), 1.333)) == pytest.approx(1.0)
    assert reflectance(torch.tensor((0.2, 0.7, 1.0)).double(), 1.0).tolist() == [0.0, 0.0, 0.0]
