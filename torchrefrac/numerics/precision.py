"""Single-precision work done in double where differences of its numbers matter."""

import torch

from torchrefrac.numerics.blocks import AnyTensor, Tensors


def in_double(function: Tensors) -> Tensors:
    """`function` computed in float64 where all tensors are float32, and rounded once; not on MPS, which has none."""

    def computed(*tensors: AnyTensor) -> tuple[AnyTensor, ...]:
        if any(tensor.dtype != torch.float32 for tensor in tensors) or tensors[0].device.type == "mps":
            return function(*tensors)
        results = function(*(tensor.double() for tensor in tensors))
        return tuple(result.float() if result.is_floating_point() else result for result in results)

    return computed
