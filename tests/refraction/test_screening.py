"""The apparent height for comparing hypotheses against the one for adjustment."""

import pytest
import torch

from tests.tolerances import DTYPES
from torchrefrac.refraction import apparent_height, screening_height

HEIGHTS = 10.0 ** torch.linspace(-1.0, 1.0, 3, dtype=torch.float64)
ANGLES = torch.deg2rad(torch.linspace(0.0, 85.0, 171, dtype=torch.float64))


def grid(index_ratio, decades):
    """Squared distance, height, depth and index (3, 41, 171) of rays at ANGLES in the air; depth/height within
    10^+-decades."""
    ratios = 10.0 ** torch.linspace(-decades, decades, 41, dtype=torch.float64)
    height, depth, tangent = HEIGHTS[:, None, None], (HEIGHTS[:, None] * ratios)[..., None], ANGLES.tan()
    index = torch.tensor(index_ratio, dtype=torch.float64)
    in_water = tangent / (index**2 + (index**2 - 1.0) * tangent**2).sqrt()
    distance_sq = (height * tangent + depth * in_water).square()
    return torch.broadcast_tensors(distance_sq, height, depth, index)


@pytest.mark.parametrize("index_ratio", [1.0, 1.0001, 1.01, 1.33, 1.7])
@pytest.mark.parametrize(
    ("dtype", "decades", "tolerance"),
    [(torch.float32, 1.0, 1e-6), (torch.float32, 2.0, 2e-6), (torch.float64, 1.0, 1e-10), (torch.float64, 2.0, 3e-9)],
)
def test_the_relative_error_is_as_stated(dtype, decades, tolerance, index_ratio):
    terms = [term.to(dtype) for term in grid(index_ratio, decades)]

    screened = screening_height(*terms)

    distance_sq, height, depth, index = (term.double() for term in terms)
    exact = apparent_height(distance_sq, height, (depth,), (index,))
    assert screened.dtype == dtype
    torch.testing.assert_close(screened.double(), exact, rtol=tolerance, atol=0.0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_straight_below_and_without_depth_it_is_the_closed_form(dtype):
    height = HEIGHTS.to(dtype)
    index, zero = height.new_tensor(1.33), torch.zeros_like(height)

    below = screening_height(zero, height, 3.0 * height, index)
    dry = screening_height(height.square(), height, zero, index)

    torch.testing.assert_close(below, height * (1.0 + 3.0 / 1.33), rtol=1e-6, atol=0.0)
    torch.testing.assert_close(dry, height, rtol=1e-6, atol=0.0)


def test_hypotheses_and_points_broadcast(draw):
    distance_sq, height, depth = draw.uniform(0.0, 9.0, 5, 7), draw.uniform(1.0, 2.0, 5, 1), draw.uniform(0.0, 9.0, 7)
    index = torch.tensor(1.33, dtype=torch.float64)

    screened = screening_height(distance_sq, height, depth, index)

    assert screened.shape == (5, 7)
    torch.testing.assert_close(screened, apparent_height(distance_sq, height, (depth,), (index,)), rtol=1e-6, atol=0.0)


def test_nothing_handed_in_is_changed(draw):
    terms = draw.uniform(1.0, 2.0, 4, 20)
    before = terms.clone()

    screening_height(terms[0], terms[1], terms[2], terms[3])

    assert torch.equal(terms, before)
