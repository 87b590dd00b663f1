"""The same surface on other devices as on the CPU."""

from dataclasses import replace

import pytest
import torch

from tests.dense.rendered_captures import sparse_scene, write_capture
from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from tests.made_device import ON_CUDA
from torchrefrac.dense import DenseOptions, densify


@pytest.mark.parametrize("device", [pytest.param("made", marks=pytest.mark.slow), ON_CUDA])
@pytest.mark.parametrize("method", ["patch", "depthmap"])
def test_the_surface_is_that_of_the_cpu(tmp_path, method, device):
    rendered = render([Board((0.0, 0.0, -40.0))], cameras_around(3, 30.0, -30.0, 1.33), marble(), 1.33)
    capture, sparse = write_capture(rendered, tmp_path), sparse_scene(rendered)
    options = DenseOptions(method=method)

    here = densify(replace(sparse, capture=capture), options).cloud
    there = densify(replace(sparse, capture=capture), replace(options, device=device)).cloud

    assert there.points.device.type == "cpu"
    assert abs(len(there) - len(here)) < 0.02 * len(here)
    nearest = torch.cdist(there.points, here.points).amin(dim=1)
    assert float(nearest.median()) < 0.02
