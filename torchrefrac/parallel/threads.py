"""Batches side by side: many small tensor operations fill one processor each, but not several together."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

S = TypeVar("S")
T = TypeVar("T")
CPU = torch.device("cpu")


def side_by_side(function: Callable[[S], T], items: Sequence[S], device: torch.device = CPU) -> list[T]:
    """`function` of each item, in order, on as many threads as PyTorch has, each with one of its own.

    PyTorch splits an operation among its threads; where operations are small, one batch a thread is nearly
    twice as fast with two threads. One after the other on a GPU, and where there is nothing to be shared out.
    """
    threads = torch.get_num_threads()
    if threads == 1 or len(items) < 2 or device.type != "cpu":
        return [function(item) for item in items]
    try:
        with ThreadPoolExecutor(min(threads, len(items)), initializer=lambda: torch.set_num_threads(1)) as pool:
            return list(pool.map(function, items))
    finally:
        torch.set_num_threads(threads)
