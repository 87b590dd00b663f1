"""What an iteration waits for: on a GPU, every look at a value holds up the processor.

The three numbers that a step is judged by are read at once by `Tensor.tolist`, which is not counted here.
"""

from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from torchrefrac.bundle import BundleOptions, Expectations, GravityPrior, ScaleBars, adjust
from torchrefrac.optim import LevenbergMarquardtOptions, minimize

LOOKS = ("_local_scalar_dense", "nonzero", "masked_select", "unique")


class Looks(TorchDispatchMode):
    """Counts the operations whose result or size depends on a value."""

    def __init__(self):
        super().__init__()
        self.seen: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        masked = name in ("index", "index_put", "index_put_") and any(
            index is not None and index.dtype == torch.bool for index in args[1]
        )
        if masked or any(look in name for look in LOOKS):
            self.seen.append(name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])
@pytest.mark.parametrize("constrained", [False, True], ids=["images alone", "constrained"])
def test_an_iteration_waits_for_nothing_but_the_three_numbers_that_judge_it(plant, disturb, index_ratio, constrained):
    planted = plant(noise=0.3, index_ratio=index_ratio)
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
        solver=LevenbergMarquardtOptions(max_iterations=1),
    )
    start = disturb(planted.truth, 0.1)
    problem = adjust(start, options, terms=terms, fixed=fixed).problem
    minimize(problem, start, replace(options.solver, max_iterations=3, function_tolerance=0.0))  # tables are made once

    looks = []
    for iterations in (1, 3):
        with Looks() as found:
            solver = replace(options.solver, max_iterations=iterations, function_tolerance=0.0)
            minimize(problem, start, solver)
        looks.append(len(found.seen))

    assert looks[1] == looks[0]
