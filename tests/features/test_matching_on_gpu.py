"""The same matches on a GPU as on the CPU."""

import pytest
import torch

from torchrefrac.features import MatchOptions, match

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def test_matches_are_those_of_the_cpu(draw):
    one = torch.nn.functional.normalize(draw.uniform(0.0, 1.0, 1500, 128).float(), dim=1)
    other = torch.nn.functional.normalize(one[torch.randperm(1500)] + 0.02 * draw.normal(1500, 128).float(), dim=1)

    here, there = match(one, other, MatchOptions()), match(one.cuda(), other.cuda(), MatchOptions())

    assert there.is_cuda
    assert len(here) > 1000
    assert torch.equal(there.cpu(), here)
