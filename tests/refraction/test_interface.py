"""The flat interface."""

import math

import pytest
import torch
from tolerances import assert_matches

from torchrefrac.refraction import FlatInterface


@pytest.mark.parametrize("bad", [0.9, 0.0, -1.333, math.nan, math.inf, torch.tensor([1.333, 0.9])])
def test_an_index_ratio_that_is_not_finite_or_below_one_is_refused(bad):
    with pytest.raises(ValueError, match=r"index_ratio is .* must be finite and at least 1"):
        FlatInterface(bad)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_index_ratio_follows_the_dtype_of_what_it_meets(dtype):
    index = FlatInterface(1.34).index_like(torch.zeros(3, dtype=dtype))

    assert index.dtype == dtype
    assert_matches(index, torch.tensor(1.34, dtype=dtype))


def test_the_gradient_reaches_an_index_ratio_that_is_estimated():
    ratio = torch.tensor(1.333, dtype=torch.float64, requires_grad=True)

    FlatInterface(ratio).index_like(torch.zeros(1, dtype=torch.float64)).backward()

    assert ratio.grad == 1.0
