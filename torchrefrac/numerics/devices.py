"""Where tensors are worked on."""

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Shaped
from torch import Tensor

AUTO = "auto"
CPU = torch.device("cpu")

T = TypeVar("T")


def device_of(name: str) -> torch.device:
    """The device that PyTorch has under a name (cpu, cuda, cuda:1); auto: a GPU with CUDA where there is one, else the
    CPU. Raises ValueError, of one sentence, for one that PyTorch cannot use here."""
    if name == AUTO:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:  # an assertion where PyTorch was built without CUDA
        reason = str(error).split("\n", maxsplit=1)[0]
        raise ValueError(f"device is {name!r}, which PyTorch cannot use here: {reason}") from None


def on_device(value: T, device: torch.device | str) -> T:
    """The same with all its tensors on a device: itself, or those in dataclasses, tuples, lists and mappings. What lies
    there is not copied."""
    return _changed(value, lambda tensor: tensor.to(device))


def detached(value: T) -> T:
    """The same without a graph in its tensors: itself, or those in dataclasses, tuples, lists and mappings."""
    return _changed(value, lambda tensor: tensor.detach() if tensor.requires_grad else tensor)


def _changed(value: Any, change: Callable[[Shaped[Tensor, "..."]], Shaped[Tensor, "..."]]) -> Any:
    """With other tensors, and itself where these are the same. What can be copied without a check is."""
    if isinstance(value, Tensor):
        return change(value)
    if is_dataclass(value) and not isinstance(value, type):
        before = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
        after = {name: _changed(part, change) for name, part in before.items()}
        changed = {name: part for name, part in after.items() if part is not before[name]}
        unchecked = {"check": False} if "check" in type(value).__dataclass_fields__ else {}
        return replace(value, **changed, **unchecked) if changed else value
    if isinstance(value, Mapping):
        after = {key: _changed(part, change) for key, part in value.items()}
        return value if all(after[key] is part for key, part in value.items()) else after
    if isinstance(value, list | tuple):
        parts = [_changed(part, change) for part in value]
        if all(one is other for one, other in zip(parts, value, strict=True)):
            return value
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    return value
