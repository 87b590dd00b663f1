"""A random order of more numbers than memory has room for."""

import torch
from jaxtyping import Int
from torch import Tensor

ROUNDS = 4
ODD = 0x9E3779B97F4A7C15 - 2**64  # 2**64 over the golden ratio, as signed
SHIFT = 29


def permuted(numbers: Int[Tensor, " n"], count: int, seed: int) -> Int[Tensor, " n"]:
    """Where a pseudo-random permutation of 0 to count - 1, of which there is one for each seed, puts some numbers.

    A Feistel network over the next power of four (Luby and Rackoff, 1988), applied again to what lies beyond the count
    (cycle walking; Black and Rogaway, 2002): no table, and each number as fast as any other. Raises ValueError for
    numbers that are not below the count.
    """
    least, most = (int(numbers.min()), int(numbers.max())) if len(numbers) else (0, 0)
    if least < 0 or most >= count > 0:
        raise ValueError(f"numbers reach from {least} to {most}, but must be 0 to {count - 1}")
    half = max((max(count - 1, 1).bit_length() + 1) // 2, 1)
    found, beyond = numbers.clone(), torch.arange(len(numbers), device=numbers.device)
    while len(beyond):
        found[beyond] = _network(found[beyond], half, seed)
        beyond = beyond[found[beyond] >= count]
    return found


def _network(numbers: Int[Tensor, " n"], half: int, seed: int) -> Int[Tensor, " n"]:
    mask = (1 << half) - 1
    left, right = numbers >> half, numbers & mask
    for number in range(ROUNDS):
        left, right = right, left ^ (_mixed(right + (((seed & 0xFFFFFFFF) << 20) + number)) & mask)
    return (left << half) | right


def _mixed(numbers: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    for _ in range(2):
        numbers = numbers * ODD
        numbers = numbers ^ (numbers >> SHIFT)
    return numbers
