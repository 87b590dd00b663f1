"""What an iteration waits for: on a GPU, every look at a value holds up the processor."""

from collections import Counter
from dataclasses import replace

import pytest
import torch

from tests.made_device import LOOKS, SIZES, UPLOADS, waits
from torchrefrac.bundle import BundleOptions, Expectations, GravityPrior, ScaleBars, adjust
from torchrefrac.numerics import on_device
from torchrefrac.optim import IterativeOptions, LevenbergMarquardtOptions, minimize


@pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])
@pytest.mark.parametrize("constrained", [False, True], ids=["images alone", "constrained"])
def test_an_iteration_waits_for_nothing_but_the_three_numbers_that_judge_it(plant, disturb, index_ratio, constrained):
    planted = plant(points=15, noise=0.3, index_ratio=index_ratio)
    terms, fixed = [], None
    if constrained:
        one = torch.ones(1, dtype=torch.float64)
        bar = ScaleBars(torch.tensor([0]), torch.tensor([1]), one, one)
        terms = [GravityPrior(planted.down_in_cam, 0.01), bar]
        fixed = torch.zeros(len(planted.truth.views.center), 6, dtype=torch.bool)
        fixed[0] = True
    options = BundleOptions(
        refine=("focal", "index_ratio", "plane_tilt") if constrained else (),
        expected=Expectations(focal=0.1, index_ratio=0.1, plane_tilt_deg=1.0),
    )

    found = _waits_of_two_iterations(disturb(planted.truth, 0.1), options, terms, fixed)

    assert found == {LOOKS: 2}  # one for all three


@pytest.mark.parametrize(
    ("solver", "of_one"),
    [("banded", {LOOKS: 3, SIZES: 2, UPLOADS: 3}), ("iterative", {LOOKS: 4, SIZES: 2, UPLOADS: 1})],
)
def test_other_solvers_wait_besides_for_the_order_of_the_unknowns_which_the_host_finds(plant, disturb, solver, of_one):
    options = BundleOptions(reduced_solver=solver, iterative=IterativeOptions(max_iterations=1))

    found = _waits_of_two_iterations(disturb(plant(points=15, noise=0.3).truth, 0.1), options)

    assert found == {kind: 2 * count for kind, count in of_one.items()}


def _waits_of_two_iterations(start, options, terms=(), fixed=None) -> Counter[str]:
    start, terms, fixed = on_device((start, terms, fixed), "made")
    first = LevenbergMarquardtOptions(max_iterations=1, function_tolerance=0.0)
    problem = adjust(start, replace(options, solver=first), terms=terms, fixed=fixed).problem  # tables are made once
    found = []
    for iterations in (1, 3):
        with waits() as counted:
            minimize(problem, start, replace(first, max_iterations=iterations))
        found.append(counted)
    return found[1] - found[0]
