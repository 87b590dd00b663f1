"""The renderer against POV-Ray, which made the photographs of the embedded tank."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

SOURCE = Path(__file__).resolve().parents[2] / "tools" / "bench" / "agreement.py"
IMAGE = 3
MIDDLE = (160, 120, 320, 240)


@pytest.fixture(scope="module")
def agreement():
    """The module tools/bench/agreement.py."""
    spec = importlib.util.spec_from_file_location("agreement", SOURCE)
    module = importlib.util.module_from_spec(spec)
    sys.modules["agreement"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["agreement"]


@pytest.fixture(scope="module")
def tank(agreement):
    return agreement.Tank()


def test_a_photograph_of_another_renderer_lies_upon_ours(tank):
    found = tank.agreement(IMAGE, samples=1, crop=MIDDLE)

    assert len(found.shifts) >= 12
    assert found.shift < 0.02
    assert np.abs(found.mean_shift).max() < 0.005
    assert found.difference < 3.0
    assert abs(found.bias) < 0.5


def test_a_shift_of_a_tenth_of_a_pixel_would_be_seen(tank):
    found = tank.agreement(IMAGE, samples=1, crop=MIDDLE, moved=(0.1, -0.05))

    assert found.mean_shift == pytest.approx([-0.1, 0.05], rel=0.2)


def test_a_wrong_index_ratio_would_be_seen(agreement):
    found = agreement.Tank(index_ratio=1.335).agreement(IMAGE, samples=1, crop=MIDDLE)

    assert found.shift > 0.1
