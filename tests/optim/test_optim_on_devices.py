"""Least squares on other devices than the CPU: the same numbers, and for what the host waits."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from tests.made_device import LOOKS, on_every_device, waits
from torchrefrac.numerics import on_device
from torchrefrac.optim import (
    Covariance,
    IterativeOptions,
    Linearized,
    Quadratic,
    conjugate_gradients,
    minimize_each,
)


@dataclass
class Wells:
    """10 + exp(a x) - b x, summed over the coordinates x of a state, for each row of data (a, b). asked: how often."""

    data: Tensor
    asked: int = 0

    def linearize(self, states: Tensor) -> Quadratic:
        self.asked += 1
        a, b = self.data[:, None].unbind(dim=-1)
        bend = (a * states).exp()
        return Quadratic(
            10.0 + (bend - b * states).sum(dim=-1), a * bend - b, torch.diag_embed(a.square() * bend).contiguous()
        )

    def subset(self, rows: Tensor) -> "Wells":
        self.data = self.data[rows]
        return self


@on_every_device
def test_many_small_problems_have_the_minima_that_they_have_on_the_cpu(draw, device):
    data, states = draw.uniform(0.5, 2.0, 40, 2), draw.normal(40, 3)

    here, there = (minimize_each(Wells(data.to(on)), states.to(on)) for on in ("cpu", device))

    assert there.states.device.type == device
    assert torch.equal(there.converged.cpu(), here.converged)
    torch.testing.assert_close(there.states.cpu(), here.states, rtol=1e-12, atol=1e-12)


def test_an_iteration_of_many_small_problems_waits_for_one_number(draw):
    wells, states = Wells(draw.uniform(0.5, 2.0, 40, 2).to("made")), (draw.normal(40, 3)).to("made")

    with waits() as counted:
        report = minimize_each(wells, states)

    assert report.converged.all()
    assert counted == {LOOKS: wells.asked}


def test_an_iteration_of_conjugate_gradients_waits_for_one_number(draw):
    root = draw.normal(30, 30)
    matrix, right = (root @ root.T + torch.eye(30)).to("made"), draw.normal(30).to("made")
    products = []

    def times(x: Tensor) -> Tensor:
        products.append(x)
        return matrix @ x

    with waits() as counted:
        x = conjugate_gradients(times, lambda x: x, right, 1e-10, 100)

    torch.testing.assert_close((matrix @ x).cpu(), right.cpu(), rtol=1e-6, atol=1e-6)
    assert counted == {LOOKS: len(products) + 1}


@on_every_device
@pytest.mark.parametrize("solver", ["dense", "banded", "iterative"])
@pytest.mark.parametrize("extra", [0, 3])
def test_steps_are_those_of_the_cpu(make_chain, solver, extra, device):
    system = make_chain(12, 60, families=[(3, 2), (1, 1)], extra=extra, ends=True).system()
    exact = IterativeOptions(tolerance=1e-14, forcing=0.0)

    here, there = (Linearized(on_device(system, on), solver, exact).solve(1e-3) for on in ("cpu", device))

    assert bool(there.solved)
    assert there.reduced.device.type == device
    torch.testing.assert_close(there.reduced.cpu(), here.reduced, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(there.eliminated.cpu(), here.eliminated, rtol=1e-10, atol=1e-12)


@on_every_device
def test_covariances_are_those_of_the_cpu(make_chain, device):
    system = make_chain(12, 60, families=[(3, 2)], extra=3).system()

    here, there = (Covariance.of(on_device(system, on)) for on in ("cpu", device))

    torch.testing.assert_close(there.eliminated().cpu(), here.eliminated(), rtol=1e-10, atol=1e-12)
