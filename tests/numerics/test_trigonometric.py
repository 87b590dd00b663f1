"""Real roots of trigonometric polynomials."""

import math

import numpy as np
import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.numerics import fourier_coefficients, roots_on_circle


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", [1, 3, 4])
def test_coefficients_are_recovered_from_samples(draw, degree, dtype):
    coefficients = draw.normal(2, 50, 2 * degree + 1).to(dtype)
    at = 2.0 * math.pi / (2 * degree + 1) * torch.arange(2 * degree + 1, dtype=torch.float64)

    samples = _values(coefficients[..., None, :].double(), at).to(dtype)

    assert_matches(fourier_coefficients(samples), coefficients)


@pytest.mark.parametrize("degree", [1, 3, 4])
def test_roots_are_those_of_the_companion_matrix_on_the_unit_circle(draw, degree):
    coefficients = draw.normal(3000, 2 * degree + 1)

    found, is_root = roots_on_circle(coefficients)

    for row, roots, mask in zip(coefficients.numpy(), found.numpy(), is_root.numpy(), strict=True):
        cosine, sine = row[1::2], row[2::2]
        positive = 0.5 * (cosine - 1j * sine)  # of exp(i k x)
        z = np.roots([*positive[::-1], row[0], *positive.conj()])
        expected = np.sort(np.angle(z[np.abs(np.log(np.abs(z))) < 1e-9]) % (2.0 * np.pi))
        np.testing.assert_allclose(np.sort(roots[mask]), expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("degree", [3, 4])
@pytest.mark.parametrize(("apart", "error"), [(0.3, 1e-13), (1e-3, 1e-11), (1e-6, 1e-8)])
def test_two_roots_beside_each_other_are_found_to_what_their_distance_leaves(draw, degree, apart, error):
    first = draw.uniform(0.0, 2.0 * math.pi, 2000, 1)
    spread = torch.linspace(0.7, 5.6, 2 * degree - 2, dtype=torch.float64) + draw.uniform(
        -0.1, 0.1, 2000, 2 * degree - 2
    )
    planted = torch.cat((first, first + apart, first + spread), dim=-1)

    found, is_root = roots_on_circle(_with_roots(planted))

    assert is_root.all()
    assert _distance(found, planted).amax() < error


def test_a_polynomial_without_roots_has_none_and_finite_entries(draw):
    coefficients = draw.normal(1000, 7)
    coefficients[:, 0] = 1.01 * coefficients[:, 1:].abs().sum(dim=-1)

    for sign in (1.0, -1.0):
        found, is_root = roots_on_circle(sign * coefficients)

        assert not is_root.any()
        assert found.isfinite().all()


def test_two_roots_that_have_just_met_are_none_and_just_before_are_two():
    coefficients = torch.tensor([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)  # 1 + cos x
    gap = torch.tensor([1e-12, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)

    assert not roots_on_circle(coefficients + gap)[1].any()
    assert roots_on_circle(coefficients - gap)[1].sum() == 2


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_zero_polynomial_has_no_roots_and_finite_entries(dtype):
    found, is_root = roots_on_circle(torch.zeros(3, 7, dtype=dtype))

    assert not is_root.any()
    assert found.isfinite().all()


def test_roots_on_the_nodes_of_the_grid_and_at_its_seam_are_found():
    found, is_root = roots_on_circle(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64))  # sin 3x

    expected = torch.arange(6, dtype=torch.float64) * (math.pi / 3.0)
    assert is_root.all()
    assert _distance(found, expected).amax() < 1e-14


def test_the_size_of_a_polynomial_does_not_matter(draw):
    coefficients = draw.normal(500, 7)
    expected, expected_mask = roots_on_circle(coefficients)

    found, is_root = roots_on_circle(coefficients * draw.power_of_ten(-100.0, 100.0, 500, 1))

    assert torch.equal(is_root, expected_mask)
    torch.testing.assert_close(found[is_root], expected[is_root], rtol=0.0, atol=1e-9)


def test_leading_dimensions_are_a_batch(draw):
    coefficients = draw.normal(2, 3, 9)

    found, is_root = roots_on_circle(coefficients)

    assert found.shape == is_root.shape == (2, 3, 8)
    alone, alone_is_root = roots_on_circle(coefficients[1, 2])
    assert_matches(found[1, 2][is_root[1, 2]].sort().values, alone[alone_is_root].sort().values)
    assert [part.shape for part in roots_on_circle(coefficients[:0])] == [(0, 3, 8), (0, 3, 8)]


def test_single_precision_stays_single(draw):
    planted = (torch.arange(6, dtype=torch.float64) + draw.uniform(-0.2, 0.2, 1000, 6)) % (2.0 * math.pi)

    found, is_root = roots_on_circle(_with_roots(planted).float())

    assert found.dtype == torch.float32
    assert is_root.all()
    assert _distance(found.double(), planted).amax() < 1e-4


def _values(coefficients, x):
    """f(x) (*B) of coefficients (*B, 2d + 1), one wave after the other."""
    total = coefficients[..., 0] + torch.zeros_like(x)
    for k in range(1, (coefficients.shape[-1] + 1) // 2):
        total = total + coefficients[..., 2 * k - 1] * (k * x).cos() + coefficients[..., 2 * k] * (k * x).sin()
    return total


def _with_roots(roots):
    """Coefficients of the product of sin((x - r) / 2) over roots (*B, 2d)."""
    count = roots.shape[-1] + 1
    at = 2.0 * math.pi / count * torch.arange(count, dtype=torch.float64)
    return fourier_coefficients((0.5 * (at - roots[..., None])).sin().prod(dim=-2))


def _distance(found, planted):
    """From every planted root (*B, n) along the circle to the next one found (*B, m)."""
    difference = found[..., None, :] - planted[..., None]
    return torch.atan2(difference.sin(), difference.cos()).abs().amin(dim=-1)
