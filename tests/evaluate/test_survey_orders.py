"""Uncertainties against the limits of S-44."""

import math

import pytest
import torch

from torchrefrac.evaluate.survey_orders import ORDERS, order_shares, vertical_uncertainty


@pytest.mark.parametrize(
    ("name", "depth", "most"),
    [
        ("exclusive", 0.0, 0.15), ("exclusive", 20.0, math.hypot(0.15, 0.15)),
        ("special", 10.0, math.hypot(0.25, 0.075)),
        ("1", 40.0, math.hypot(0.5, 0.52)), ("2", 100.0, math.hypot(1.0, 2.3)),
    ],
)  # fmt: skip
def test_limits_are_those_of_table_1(name, depth, most):
    (order,) = (each for each in ORDERS if each.name == name)
    assert float(order.most(torch.tensor(depth, dtype=torch.float64))) == pytest.approx(most)


def test_shares_are_those_of_cells_that_an_order_allows():
    sigma = torch.tensor([0.01, 0.1, 0.2, 0.6], dtype=torch.float64)
    depth = torch.full((4,), 2.0, dtype=torch.float64)

    assert order_shares(depth, sigma, "m") == {"exclusive": 0.25, "special": 0.5, "1": 0.75, "2": 0.75}
    assert order_shares(100.0 * depth, 100.0 * sigma, "cm") == order_shares(depth, sigma, "m")
    assert order_shares(depth, sigma, "unit") == order_shares(depth[:0], sigma[:0], "m") == {}
    assert float(vertical_uncertainty(sigma)[1]) == pytest.approx(0.196, abs=1e-4)
