"""Single-precision work done in double where differences of its numbers matter."""

import torch

from torchrefrac.numerics.blocks import AnyTensor, Tensors


def in_double(function: Tensors) -> Tensors:
    """`function` computed in float64 for float32 tensors and rounded once; MPS has no float64 and stays as it is."""

    def computed(*tensors: AnyTensor) -> tuple[AnyTensor, ...]:
        if tensors[0].dtype != torch.float32 or tensors[0].device.type == "mps":
            return function(*tensors)
        results = function(*(tensor.double() for tensor in tensors))
        return tuple(result.float() if result.is_floating_point() else result for result in results)

    return computed
