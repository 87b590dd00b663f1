"""Checks of what users hand in: a leaf that any layer may import. Every failure is a ValueError of one sentence."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch._C import _functorch  # pyright: ignore[reportAttributeAccessIssue]

from torchrefrac.errors import TorchrefracError as TorchrefracError  # noqa: PLC0414 - checks raise it elsewhere

HALF = (torch.float16, torch.bfloat16)


class Range(NamedTuple):
    """What a number may be, as `require` takes it."""

    at_least: float | None = None
    above: float | None = None
    at_most: float | None = None


def require(
    value: Shaped[Tensor, "..."] | float,
    name: str,
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
) -> None:
    """Refuse values that are not finite or lie outside the bounds.

    Compiled code cannot look at values: there nothing is checked. Under `torch.func` transforms the values
    inside the wrappers are.
    """
    if torch.compiler.is_compiling() or (isinstance(value, Tensor) and value.numel() == 0):
        return
    ends = torch.aminmax(unwrapped(value)) if isinstance(value, Tensor) else (value, value)  # NaN if there is one
    low, high = map(_as_float, ends)
    too_low = (at_least is not None and low < at_least) or (above is not None and low <= above)
    too_high = at_most is not None and high > at_most
    if math.isfinite(low) and math.isfinite(high) and not (too_low or too_high):
        return
    bad = low if too_low or not math.isfinite(low) else high
    bounds = (("at least", at_least), ("above", above), ("at most", at_most))
    wants = " and ".join(("finite", *(f"{words} {bound:g}" for words, bound in bounds if bound is not None)))
    where = " somewhere" if isinstance(value, Tensor) and value.dim() else ""
    raise ValueError(f"{name} is {bad:g}{where}, but must be {wants}")


def require_ranges(options: object, ranges: Mapping[str, Range]) -> None:
    """Refuse options outside their ranges, by their names; each number of those that are lists. None is no number."""
    for name, (at_least, above, at_most) in ranges.items():
        value = getattr(options, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None:
                require(number, name, at_least=at_least, above=above, at_most=at_most)


def _as_float(number: Shaped[Tensor, ""] | float) -> float:
    """Infinite where a whole number is too large for one."""
    try:
        return float(number)
    except OverflowError:
        return math.inf if number > 0 else -math.inf


def require_between(value: float, name: str, low: float, high: float, unit: str = "") -> None:
    """Refuse numbers outside low to high."""
    if not low <= value <= high:
        wanted = f"must lie between {low:g} and {high:g}{unit and f' {unit}'}"
        raise ValueError(f"{name} is {_as_float(value):g}, but {wanted}")


def require_floating(value: Shaped[Tensor, "..."] | float, name: str) -> None:
    """Refuse tensors of whole numbers, and True and False as numbers."""
    if isinstance(value, bool):
        raise ValueError(f"{name} is {value}, but must be a number")
    if isinstance(value, Tensor) and not value.is_floating_point():
        raise ValueError(f"{name} has dtype {value.dtype}, but must be a floating-point tensor")


def require_rotation(value: Float[Tensor, "*batch 3 3"], name: str) -> None:
    """Refuse matrices whose rows are not orthonormal and right-handed to three digits, to two in half precision.

    Nothing is checked in compiled code nor inside the wrappers of `torch.func` transforms, which may lay out the
    dimensions of a matrix in any order.
    """
    if torch.compiler.is_compiling() or is_wrapped(value) or value.numel() == 0:
        return
    require(value, name)
    x, y, z = at_least_single(value.detach()).unbind(dim=-2)
    products = torch.stack((x * x, y * y, x * y)).sum(dim=-1)
    unit = (products[0] - 1.0, products[1] - 1.0, products[2])
    error = max(float(part.abs().max()) for part in (*unit, torch.linalg.cross(x, y, dim=-1) - z))
    if error > (0.02 if value.dtype in HALF else 0.001):
        raise ValueError(
            f"{name} must be a rotation: its rows are off by {error:g} somewhere from orthonormal and right-handed"
        )


def require_ending(value: Shaped[Tensor, "..."], name: str, ending: Sequence[int]) -> None:
    """Refuse tensors whose last dimensions are not `ending`."""
    if tuple(value.shape[-len(ending) :]) != tuple(ending):
        wants = str(tuple(ending)) if len(ending) > 1 else f"({ending[0]},)"
        raise ValueError(f"{name} has shape {tuple(value.shape)}, but must end in {wants}")


def require_broadcasting(**shapes: Sequence[int]) -> torch.Size:
    """The shape that all of them broadcast to."""
    if not torch.compiler.is_compiling():  # PyTorch takes 0.2 ms for what is nearly always plain
        different = {tuple(shape) for shape in shapes.values() if len(shape)}
        if len(different) <= 1:
            return torch.Size(different.pop() if different else ())
    try:
        return torch.broadcast_shapes(*shapes.values())
    except RuntimeError:
        listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise ValueError(f"shapes do not broadcast: {listed}") from None


def at_least_single(value: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
    """Half precision raised to float32: pixels and refraction need more than three digits."""
    return value.float() if value.dtype in HALF else value


def holds_everywhere(condition: Bool[Tensor, "..."]) -> bool:
    """Whether a mask is True throughout; True, unseen, in compiled code."""
    return torch.compiler.is_compiling() or bool(unwrapped(condition).all())


def unwrapped(value: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
    """The values inside the wrappers of `torch.func` transforms."""
    value = value.detach()
    while is_wrapped(value):
        value = _functorch.get_unwrapped(value)
    return value


def can_be_looked_at(values: Shaped[Tensor, "..."]) -> bool:
    """Whether what is computed may depend on numbers: on a GPU they can be looked at only at a price, and not at all
    while a function is compiled or transformed, or where its derivative is wanted."""
    is_far = values.device.type != "cpu"
    return not (is_far or torch.compiler.is_compiling() or values.requires_grad or is_wrapped(values))


def is_wrapped(value: Shaped[Tensor, "..."]) -> bool:
    """Whether a `torch.func` transform holds the tensor."""
    return _functorch.is_functorch_wrapped_tensor(value)
