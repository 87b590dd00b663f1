"""Devices by their names."""

import pytest
import torch

from torchrefrac.numerics import device_of


def test_auto_is_a_gpu_where_there_is_one(monkeypatch):
    for there, kind in ((False, "cpu"), (True, "cuda")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert device_of("auto").type == kind


def test_a_device_that_is_not_there_is_refused_in_a_sentence():
    assert device_of("cpu") == torch.device("cpu")
    with pytest.raises(ValueError, match="device is 'abacus', which PyTorch cannot use here: "):
        device_of("abacus")
