"""The sensor: blur against a convolution, noise by its standard deviation, grey values whole and within 0 to 255."""

import numpy as np
import pytest
import torch

from torchrefrac.synthetic.options import SensorOptions
from torchrefrac.synthetic.photograph import develop

PERFECT = SensorOptions(blur=0.0, noise=0.0)


def test_a_perfect_sensor_rounds_and_stays_within_eight_bits():
    light = torch.tensor([[[-3.0, 0.4, 0.6], [127.51, 254.6, 300.0]]])

    assert develop(light, PERFECT, 0, 0).tolist() == [[[0, 0, 1], [128, 255, 255]]]


def test_blur_is_a_convolution_with_a_gaussian():
    light = torch.zeros(21, 21, 3)
    light[10, 10] = 10_000.0

    image = develop(light, SensorOptions(blur=1.5, noise=0.0), 0, 0)

    x = np.arange(-10, 11)
    spot = np.exp(-(x**2) / (2 * 1.5**2))
    spot /= spot.sum()
    wanted = np.clip(np.rint(10_000.0 * spot[:, None] * spot), 0, 255)
    assert np.abs(image[..., 1] - wanted).max() <= 1


def test_noise_has_the_standard_deviation_that_was_asked_for():
    image = develop(torch.full((200, 200, 3), 128.0), SensorOptions(blur=0.0, noise=4.0), 5, 0)

    assert image.mean() == pytest.approx(128.0, abs=0.1)
    assert image.std() == pytest.approx(np.hypot(4.0, 1 / np.sqrt(12)), rel=0.02)


def test_noise_depends_on_the_seed_and_the_image_alone():
    light = torch.full((20, 20, 3), 128.0)
    options = SensorOptions(noise=4.0)

    first = develop(light, options, 5, 2)
    torch.manual_seed(99)
    again, other_image, other_seed = (develop(light, options, *which) for which in ((5, 2), (5, 3), (6, 2)))

    assert np.array_equal(first, again)
    assert not np.array_equal(first, other_image)
    assert not np.array_equal(first, other_seed)
