"""Refraction on other devices than the CPU."""

import pytest
import torch

from tests.made_device import on_every_device
from torchrefrac import solve_refrax
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface, lift_points


@on_every_device
@pytest.mark.parametrize("method", ["halley", "newton", "companion"])
def test_refrax_ratios_and_their_derivatives_are_those_of_the_cpu(draw, method, device):
    case = [draw.power_of_ten(-1.0, 1.0, 200) for _ in range(3)] + [draw.uniform(1.0, 1.5, 200)]

    found = []
    for on in ("cpu", device):
        numbers = [number.clone().to(on).requires_grad_() for number in case]
        ratio = solve_refrax(*numbers, method=method)
        assert ratio.device.type == on
        ratio.sum().backward()
        found.append([ratio.detach().cpu(), *(number.grad.cpu() for number in numbers)])

    for there, here in zip(*reversed(found), strict=True):
        torch.testing.assert_close(there, here, rtol=1e-12, atol=1e-12)


@on_every_device
@pytest.mark.parametrize("interface", [FlatInterface(1.333), FlatInterface.slab(Plane(), 0.2)], ids=["water", "slab"])
def test_apparent_points_are_those_of_the_cpu(draw, interface, device):
    center = draw.normal(200, 3) + torch.tensor((0.0, 0.0, 3.0), dtype=torch.float64)
    points = draw.normal(200, 3) - torch.tensor((0.0, 0.0, 4.0), dtype=torch.float64)

    there, valid = lift_points(center.to(device), points.to(device), interface)

    here, expected = lift_points(center, points, interface)
    assert there.device.type == device
    assert torch.equal(valid.cpu(), expected)
    torch.testing.assert_close(there.cpu(), here, rtol=1e-12, atol=1e-12)
