"""The same matches on other devices as on the CPU."""

import torch

from tests.made_device import on_every_device
from torchrefrac.features import MatchOptions, match


@on_every_device
def test_matches_are_those_of_the_cpu(draw, device):
    one = torch.nn.functional.normalize(draw.uniform(0.0, 1.0, 1500, 128).float(), dim=1)
    other = torch.nn.functional.normalize(one[torch.randperm(1500)] + 0.02 * draw.normal(1500, 128).float(), dim=1)

    here, there = match(one, other, MatchOptions()), match(one.to(device), other.to(device), MatchOptions())

    assert there.device.type == device
    assert len(here) > 1000
    assert torch.equal(there.cpu(), here)
