"""Elementwise work on large batches, block by block, so that intermediate results stay in the processor's cache."""

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from jaxtyping import Shaped
from torch import Tensor

from torchrefrac.checks import is_wrapped

BLOCK = 32768
AnyTensor = Shaped[Tensor, "..."]
Tensors = Callable[..., tuple[AnyTensor, ...]]  # a function of several tensors that gives several


def in_blocks(
    function: Tensors,
    tensors: Sequence[AnyTensor],
    event_dims: Sequence[int],
    result_dims: Sequence[int],
    size: int = BLOCK,
) -> tuple[AnyTensor, ...]:
    """`function(*tensors)`, computed for at most `size` elements of the batch at a time; each is treated alone.

    The last `event_dims[i]` dimensions of tensor i belong to one element, those before them broadcast to the batch;
    result i is the batch followed by `result_dims[i]` dimensions. Only plain CPU tensors without a graph are split: on
    a GPU, in a transform, in a compiled function and for autograd the whole is one block.
    """
    batch = torch.broadcast_shapes(*(t.shape[: t.dim() - k] for t, k in zip(tensors, event_dims, strict=True)))
    if math.prod(batch) <= size or not all(_is_plain(tensor) for tensor in tensors):
        whole = zip(function(*tensors), result_dims, strict=True)
        return tuple(result.expand((*batch, *result.shape[result.dim() - k :])) for result, k in whole)
    spread = [
        t if t.dim() == k else t.expand((*batch, *t.shape[t.dim() - k :]))
        for t, k in zip(tensors, event_dims, strict=True)
    ]
    shared = [t.dim() == k for t, k in zip(tensors, event_dims, strict=True)]
    results: list[AnyTensor] = []
    for block in _blocks(batch, size):
        parts = function(*(t if is_shared else t[block] for t, is_shared in zip(spread, shared, strict=True)))
        results = results or [
            part.new_empty((*batch, *part.shape[part.dim() - k :])) for part, k in zip(parts, result_dims, strict=True)
        ]
        for result, part, k in zip(results, parts, result_dims, strict=True):
            flat = part.flatten(part.dim() - k) if k else part
            result.view((*batch, *flat.shape[flat.dim() - min(k, 1) :]))[block] = flat  # in 2D a transpose is fast
    return tuple(results)


def _blocks(batch: Sequence[int], size: int) -> Iterator[tuple[slice, ...]]:
    """Slices of the leading dimensions: each cuts out at most `size` elements that lie together."""
    inner = math.prod(batch[1:])
    if inner > size:
        for i in range(batch[0]):
            yield from ((slice(i, i + 1), *rest) for rest in _blocks(batch[1:], size))
    else:
        step = size // max(inner, 1)
        for i in range(0, batch[0], step):
            yield (slice(i, i + step),)


def _is_plain(tensor: AnyTensor) -> bool:
    if torch.compiler.is_compiling() or tensor.device.type != "cpu":
        return False
    graph = tensor.requires_grad and torch.is_grad_enabled()
    return not (graph or is_wrapped(tensor))


def in_double(function: Tensors) -> Tensors:
    """`function` computed in float64 where all tensors but masks are float32, and rounded once; not on MPS, which has
    none."""

    def computed(*tensors: AnyTensor) -> tuple[AnyTensor, ...]:
        numbers = [tensor for tensor in tensors if tensor.dtype != torch.bool]
        if any(tensor.dtype != torch.float32 for tensor in numbers) or tensors[0].device.type == "mps":
            return function(*tensors)
        results = function(*(tensor if tensor.dtype == torch.bool else tensor.double() for tensor in tensors))
        return tuple(result.float() if result.is_floating_point() else result for result in results)

    return computed
