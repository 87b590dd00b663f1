"""The same adjustment on other devices as on the CPU."""

import pytest
import torch

from tests.made_device import on_every_device
from torchrefrac.bundle import BundleOptions, GravityPrior, ScaleBars, adjust, uncertainty
from torchrefrac.numerics import on_device
from torchrefrac.optim import LevenbergMarquardtOptions

THREE = LevenbergMarquardtOptions(max_iterations=3)
REFINED = ("focal", "index_ratio", "plane_tilt")


@on_every_device
@pytest.mark.parametrize("solver", ["dense", "banded", "iterative"])
@pytest.mark.parametrize("refine", [(), REFINED], ids=["poses and points", "more"])
def test_the_adjusted_scene_is_that_of_the_cpu(plant, disturb, solver, refine, device):
    start = disturb(plant(points=12, noise=0.3).truth, 0.1)
    options = BundleOptions(reduced_solver=solver, refine=refine, solver=THREE)

    here, there = (adjust(on_device(start, on), options) for on in ("cpu", device))

    assert there.status == here.status == "max_iterations"
    assert set(there.fixed) == set(here.fixed)
    assert there.scene.points.device.type == device
    _assert_same(there.scene.points, here.scene.points)
    _assert_same(there.scene.views.center, here.scene.views.center)
    _assert_same(there.scene.cameras.focal, here.scene.cameras.focal)


@on_every_device
def test_with_measurements_scene_and_uncertainty_are_those_of_the_cpu(plant, disturb, device):
    planted = plant(points=12, noise=0.3, cameras=2, interfaces=2, glass=1.0)
    start, one = disturb(planted.truth, 0.1), torch.ones(1, dtype=torch.float64)
    terms = [
        GravityPrior(planted.down_in_cam, 0.01),
        ScaleBars(torch.tensor([0]), torch.tensor([1]), 20.0 * one, 0.1 * one),
    ]
    fixed = torch.zeros(len(start.views), 6, dtype=torch.bool)
    fixed[0] = True

    reports = [
        adjust(on_device(start, on), BundleOptions(solver=THREE), terms=on_device(terms, on), fixed=fixed.to(on))
        for on in ("cpu", device)
    ]

    here, there = (uncertainty(report.problem, report.scene) for report in reports)
    _assert_same(reports[1].scene.points, reports[0].scene.points)
    _assert_same(there.points, here.points)
    _assert_same(there.pose, here.pose)
    assert there.effective_sigma == pytest.approx(here.effective_sigma, rel=1e-9)


def _assert_same(there, here):
    torch.testing.assert_close(there.cpu(), here, rtol=1e-9, atol=1e-9)
