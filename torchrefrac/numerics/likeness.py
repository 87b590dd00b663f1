"""Numbers as tensors beside others."""

from torch import Tensor


def like(value: Tensor | float, reference: Tensor) -> Tensor:
    """`value` in the dtype and on the device of `reference`; a number is written there, not copied from the host."""
    if isinstance(value, Tensor):
        return value.to(dtype=reference.dtype, device=reference.device)
    return reference.new_full((), value)
