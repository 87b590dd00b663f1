"""Elementwise work on large batches, block by block, so that intermediate results stay in the processor's cache."""

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from torchrefrac.checks import is_wrapped

BLOCK = 32768


def in_blocks(
    function: Callable[..., tuple[Tensor, ...]], tensors: Sequence[Tensor], event_dims: Sequence[int]
) -> tuple[Tensor, ...]:
    """`function(*tensors)`, computed for a part of the batch at a time; it must treat every element alone.

    The last `event_dims[i]` dimensions of tensor i belong to one element, those before them broadcast to the batch,
    and every result leads with the batch. Only plain CPU tensors without a graph are split: on a GPU, in a
    transform, in a compiled function and for autograd the whole is one block.
    """
    batch = torch.broadcast_shapes(*(t.shape[: t.dim() - k] for t, k in zip(tensors, event_dims, strict=True)))
    if math.prod(batch) <= BLOCK or not all(_is_plain(tensor) for tensor in tensors):
        return function(*tensors)
    whole = [t.expand(*batch, *t.shape[t.dim() - k :]) for t, k in zip(tensors, event_dims, strict=True)]
    results: list[Tensor] = []
    for block in _blocks(batch):
        parts = function(*(tensor[block] for tensor in whole))
        results = results or [part.new_empty(*batch, *part.shape[len(batch) :]) for part in parts]
        for result, part in zip(results, parts, strict=True):
            result[block] = part
    return tuple(results)


def _blocks(batch: Sequence[int]) -> Iterator[tuple[slice, ...]]:
    """Slices of the leading dimensions: each cuts out at most BLOCK elements that lie together."""
    inner = math.prod(batch[1:])
    if inner > BLOCK:
        for i in range(batch[0]):
            yield from ((slice(i, i + 1), *rest) for rest in _blocks(batch[1:]))
    else:
        step = BLOCK // max(inner, 1)
        for i in range(0, batch[0], step):
            yield (slice(i, i + step),)


def _is_plain(tensor: Tensor) -> bool:
    if torch.compiler.is_compiling() or tensor.device.type != "cpu":
        return False
    graph = tensor.requires_grad and torch.is_grad_enabled()
    return not (graph or is_wrapped(tensor))
