"""What `solve_refrax` refuses, and that its message names the argument at fault."""

import math

import pytest
import torch

from torchrefrac.refraction import solve_refrax

GOOD = {"height": 1.0, "depth": 1.0, "distance": 1.0, "index_ratio": 1.333}


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("height", 0.0),
        ("height", -1.0),
        ("depth", -1e-9),
        ("distance", -1.0),
        ("index_ratio", 0.999),
        *[(name, value) for name in GOOD for value in (math.nan, math.inf)],
    ],
)
def test_a_value_out_of_range_is_named_with_what_it_is(name, bad):
    values = torch.full((3,), GOOD[name], dtype=torch.float64)
    values[1] = bad

    with pytest.raises(ValueError, match=rf"^{name} is {bad:g} somewhere, but must be finite and"):
        solve_refrax(**{**GOOD, name: values})


@pytest.mark.parametrize("name", GOOD)
def test_an_integer_tensor_is_refused_by_name(name):
    with pytest.raises(ValueError, match=rf"^{name} has dtype torch.int64"):
        solve_refrax(**{**GOOD, name: torch.tensor([2])})


def test_shapes_that_do_not_broadcast_are_listed():
    with pytest.raises(ValueError, match=r"height \(2,\), depth \(\), distance \(3,\), index_ratio \(\)"):
        solve_refrax(torch.ones(2), 1.0, torch.ones(3), 1.333)


def test_an_unknown_method_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="method is 'bisection', but must be one of halley, newton, companion"):
        solve_refrax(**GOOD, method="bisection")
