"""Batched real roots."""

import numpy as np
import pytest
import torch

from tests.tolerances import assert_matches
from torchrefrac.numerics import real_roots


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 8])
def test_roots_are_those_of_numpy(draw, degree):
    coefficients = draw.normal(200, degree + 1)

    roots, is_real = real_roots(coefficients)

    for row, root, real in zip(coefficients.numpy(), roots, is_real, strict=True):
        expected = np.roots(row)
        np.testing.assert_allclose(np.sort(root.numpy()), np.sort(expected.real), rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(
            np.sort(root[real].numpy()), np.sort(expected.real[expected.imag == 0]), rtol=1e-8, atol=1e-8
        )


def test_a_double_root_counts_as_real_although_rounding_splits_it(draw):
    double, gap = draw.uniform(-3.0, 3.0, 500), draw.uniform(0.5, 3.0, 500)
    planted = torch.stack((double, double, double + gap, double - 2.0 * gap), dim=-1)

    roots, is_real = real_roots(_polynomials(planted))

    assert is_real.all()
    torch.testing.assert_close(roots.sort(dim=-1).values, planted.sort(dim=-1).values, rtol=1e-6, atol=1e-5)


def test_a_conjugate_pair_is_masked_out_and_its_real_part_returned():
    roots, is_real = real_roots(torch.tensor([1.0, -4.0, 5.0], dtype=torch.float64))  # 2 +- i

    assert not is_real.any()
    assert_matches(roots, torch.full_like(roots, 2.0))


def test_the_tolerance_decides_how_far_from_the_real_axis_a_root_may_lie():
    nearly_real = torch.tensor([1.0, 0.0, 1e-6], dtype=torch.float64)  # +- 0.001 i

    assert not real_roots(nearly_real, tolerance=0.9e-3)[1].any()
    assert real_roots(nearly_real, tolerance=1.1e-3)[1].all()


def test_leading_dimensions_are_a_batch(draw):
    coefficients = draw.normal(2, 3, 5)

    roots, is_real = real_roots(coefficients)

    assert roots.shape == is_real.shape == (2, 3, 4)
    alone, _ = real_roots(coefficients[1, 2])
    torch.testing.assert_close(roots[1, 2].sort().values, alone.sort().values, rtol=1e-10, atol=1e-10)


def _polynomials(roots: torch.Tensor) -> torch.Tensor:
    return torch.as_tensor(np.stack([np.poly(row) for row in roots.numpy()]))
