"""A device that is none: tensors that PyTorch takes to lie elsewhere, while the CPU computes what becomes of them.

Importing this module gives PyTorch a device `made`, which is as strict as a GPU or stricter: tensors of both devices do
not meet, numbers without dimensions excepted, also where CUDA copies unasked, as an index from the host; nor does a
generator of the host draw there. It counts for what the host would wait (`waits`): numbers that it looks at, tensors
that it hands over, results whose size depends on values.

What it cannot show: operations that CUDA does not have, its rounding, and what code does only where `is_cuda` is True.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._mode_utils import no_dispatch
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

aten = torch.ops.aten

_setup_privateuseone_for_python_backend("made")
MADE = torch.device("made", 0)

needs_cuda = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
ON_CUDA = pytest.param("cuda", marks=needs_cuda)
on_every_device = pytest.mark.parametrize("device", ["made", ON_CUDA])

LOOKS, UPLOADS, SIZES = "looks", "uploads", "sizes"
LOOKING = {
    *("_local_scalar_dense", "equal", "is_nonzero", "_linalg_check_errors"),
    *("_linalg_eigh", "linalg_eig", "_linalg_svd"),  # which check whether they have converged
}
SIZED = {
    *("nonzero", "masked_select", "bincount"),
    *("_unique", "_unique2", "unique_dim", "unique_consecutive", "unique_dim_consecutive"),
}
COPYING, JOINING = {"_to_copy", "copy_"}, {"cat", "stack"}
MADE_AT_ONCE = (
    *(aten.arange.default, aten.arange.start, aten.arange.start_step, aten.eye.default, aten.eye.m),
    *(aten.tril_indices.default, aten.triu_indices.default),
)
"""PyTorch would otherwise make these of others that change the shape of a tensor."""

_counters: list[Counter[str]] = []


class MixedDevicesError(RuntimeError):
    """Tensors of two devices meet."""


class MadeTensor(Tensor):
    """here: the same on the CPU."""

    here: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, here: Tensor) -> "MadeTensor":
        layout = {"strides": here.stride(), "storage_offset": here.storage_offset(), "dtype": here.dtype}
        made = Tensor._make_wrapper_subclass(cls, here.shape, device=MADE, **layout)
        made.here = here
        return made

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(function, *args, **(kwargs or {}))

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def __repr__(self, **_: Any) -> str:
        return f"made({self.here!r})"


@contextmanager
def waits() -> Iterator[Counter[str]]:
    """How often the host would wait for the device: LOOKS, UPLOADS and SIZES."""
    counter: Counter[str] = Counter()
    _counters.append(counter)
    try:
        yield counter
    finally:
        _counters.remove(counter)


@contextmanager
def without_waiting(device: str) -> Iterator[None]:
    """Fails where the host would wait for the device."""
    if device == MADE.type:
        with waits() as counted:
            yield
        assert not counted
        return
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def _computed(function: Any, *args: Any, **kwargs: Any) -> Any:
    """By the CPU what is asked for of tensors there, or of none."""
    name, device = function._schema.name.removeprefix("aten::"), kwargs.get("device")
    tensors = list(_tensors((*args, *kwargs.values())))
    is_there = not tensors or any(isinstance(tensor, MadeTensor) for tensor in tensors)
    goes_there = is_there if device is None else torch.device(device).type == MADE.type
    if name == "copy_":
        goes_there, is_there = (isinstance(one, MadeTensor) for one in args[:2])
    elif name not in COPYING:
        _require_together(name, tensors, kwargs)
    _count(name, args, kwargs, is_there, goes_there)
    if device is not None:
        kwargs["device"] = torch.device("cpu")
    known = {id(_on_cpu(tensor)): tensor for tensor in tensors}
    found = function(*_mapped(_on_cpu, args), **{key: _mapped(_on_cpu, value) for key, value in kwargs.items()})
    if torch.Tag.inplace_view in function.tags:
        with no_dispatch():
            function(*args, **kwargs)  # the wrapper has the new shape, too
    return _mapped(lambda tensor: _answer(tensor, known, goes_there), found)


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _tensors(part)


def _mapped(function: Callable[[Tensor], Tensor], value: Any) -> Any:
    """With what a function makes of each tensor."""
    if isinstance(value, Tensor):
        return function(value)
    return type(value)(_mapped(function, part) for part in value) if isinstance(value, list | tuple) else value


def _on_cpu(tensor: Tensor) -> Tensor:
    return tensor.here if isinstance(tensor, MadeTensor) else tensor


def _answer(tensor: Tensor, known: Mapping[int, Tensor], goes_there: bool) -> Tensor:
    """What was written to is the tensor that was given."""
    if (given := known.get(id(tensor))) is not None:
        if given.shape != tensor.shape or given.stride() != tensor.stride():
            raise NotImplementedError("a tensor of the made device cannot change its shape")
        return given
    return MadeTensor(tensor) if goes_there else tensor


def _require_together(name: str, tensors: Sequence[Tensor], kwargs: Mapping[str, Any]) -> None:
    apart = [one for one in tensors if not isinstance(one, MadeTensor) and (one.dim() > 0 or name in JOINING)]
    if apart and len(apart) < len(tensors):
        raise MixedDevicesError(f"{name} of tensors there and of one of shape {tuple(apart[0].shape)} on the CPU")
    if isinstance(kwargs.get("generator"), torch.Generator):
        raise MixedDevicesError(f"{name} draws there by a generator of the CPU")


def _count(name: str, args: Sequence[Any], kwargs: Mapping[str, Any], is_there: bool, goes_there: bool) -> None:
    kinds = {
        LOOKS: name in LOOKING or (name in COPYING and is_there and not goes_there),
        UPLOADS: name in COPYING and goes_there and not is_there,
        SIZES: name in SIZED or _depends_on_values(name, args, kwargs),
    }
    for counter in _counters:
        counter.update(kind for kind, counts in kinds.items() if counts)


def _depends_on_values(name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> bool:
    if name == "repeat_interleave":
        return kwargs.get("output_size") is None
    if name not in ("index", "index_put", "index_put_"):
        return False
    masked = any(isinstance(one, Tensor) and one.dtype == torch.bool for one in args[1])
    return masked and (name == "index" or args[2].dim() > 0)  # a number goes to where a mask is without looking


def _handed_over(source: Tensor, target: Tensor, _: bool = False) -> Tensor:
    return _computed(aten.copy_.default, target, source)


_library = torch.library.Library("_", "IMPL")
_library.fallback(_computed, "PrivateUse1")
_operations = torch.library.Library("aten", "IMPL")
_operations.impl("_copy_from", _handed_over, "PrivateUse1")
for _operation in MADE_AT_ONCE:
    _operations.impl(_operation, partial(_computed, _operation), "PrivateUse1")
