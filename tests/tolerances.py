"""What each dtype is held to: the one table that every test reads its tolerances from."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Tolerance:
    """rounding: a few dozen operations, relative to the size of the numbers; solve: relative error of a refrax ratio
    for depth/height within 10^+-3 up to 89.9 degrees; pixel: absolute, in an image about a thousand pixels wide."""

    rounding: float
    solve: float
    pixel: float


TOLERANCE = {
    torch.float64: Tolerance(rounding=1e-13, solve=1e-13, pixel=1e-9),
    torch.float32: Tolerance(rounding=2e-5, solve=1e-5, pixel=5e-3),
}
DTYPES = tuple(TOLERANCE)
EXACT = TOLERANCE[torch.float64]


def assert_matches(actual: Tensor, expected: Tensor, slack: float = 1.0) -> None:
    """Equal to rounding of the dtype of `actual`: relatively, or absolutely where `expected` is below 1."""
    tolerance = slack * TOLERANCE[actual.dtype].rounding
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


def assert_same_pixels(actual: Tensor, expected: Tensor, slack: float = 1.0) -> None:
    """Equal to the pixel tolerance of the dtype of `actual`."""
    torch.testing.assert_close(actual, expected, rtol=0.0, atol=slack * TOLERANCE[actual.dtype].pixel)
