"""Numbers as tensors beside others."""

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.checks import at_least_single, require_broadcasting, require_floating


def like(value: Shaped[Tensor, "*shape"] | float, reference: Shaped[Tensor, "..."]) -> Shaped[Tensor, "*shape"]:
    """`value` in the dtype and on the device of `reference`; a number is written there, not copied from the host."""
    if isinstance(value, Tensor):
        return value.to(dtype=reference.dtype, device=reference.device)
    return reference.new_full((), value)


def alike(**values: Shaped[Tensor, "..."] | float) -> list[Float[Tensor, "*#batch"]]:
    """Tensors of one dtype on one device: that of the tensors among them, at least single; else double precision.

    Raises ValueError that names the arguments for tensors of whole numbers and for shapes that do not broadcast.
    """
    for name, value in values.items():
        require_floating(value, name)
    given = [at_least_single(value) for value in values.values() if isinstance(value, Tensor)]
    dtype = given[0].dtype if given else torch.float64
    for tensor in given[1:]:
        dtype = torch.promote_types(dtype, tensor.dtype)
    device = given[0].device if given else None
    tensors = [torch.as_tensor(value, dtype=dtype, device=device) for value in values.values()]
    require_broadcasting(**{name: tensor.shape for name, tensor in zip(values, tensors, strict=True)})
    return tensors
