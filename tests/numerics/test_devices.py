"""Devices by their names, and what is moved to them."""

from dataclasses import dataclass, field
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from tests.made_device import on_every_device
from torchrefrac.numerics import CPU, device_of, on_device


class Pair(NamedTuple):
    first: Tensor
    second: int


@dataclass(frozen=True)
class Held:
    """Tensors in every kind of thing."""

    pair: Pair
    name: str = "held"
    by_name: dict[str, Tensor | float] = field(default_factory=dict)
    inner: "Held | None" = None


def test_auto_is_a_gpu_where_there_is_one(monkeypatch):
    for there, kind in ((False, "cpu"), (True, "cuda")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert device_of("auto").type == kind


def test_a_device_that_is_not_there_is_refused_in_a_sentence():
    assert device_of("cpu") == torch.device("cpu")
    with pytest.raises(ValueError, match="device is 'abacus', which PyTorch cannot use here: "):
        device_of("abacus")


@on_every_device
def test_whatever_holds_tensors_is_moved_with_all_of_them(device):
    one = torch.ones(2)
    held = Held(Pair(one, 3), by_name={"a": one, "b": 0.5}, inner=Held(Pair(one, 4)))

    first, second, text = on_device((held, [one], "text"), device)

    assert isinstance(first.pair, Pair)
    assert first.inner is not None
    assert (first.pair.second, first.inner.pair.second, first.by_name["b"], text) == (3, 4, 0.5, "text")
    for tensor in (first.pair.first, first.inner.pair.first, first.by_name["a"], *second):
        assert tensor.device.type == device
        assert torch.equal(tensor.cpu(), one)


def test_what_lies_there_already_stays_the_same_object():
    held = Held(Pair(torch.ones(2), 3), by_name={"a": torch.ones(2)})

    assert on_device(held, CPU) is held
