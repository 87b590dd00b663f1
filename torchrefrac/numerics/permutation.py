"""A random order of more numbers than memory has room for."""

import math

import torch
from jaxtyping import Int
from torch import Tensor

ROUNDS = 6
ODD = 0x9E3779B97F4A7C15 - 2**64  # 2**64 over the golden ratio, as signed
SHIFT = 29


def permuted(numbers: Int[Tensor, " n"], count: int, seed: int) -> Int[Tensor, " n"]:
    """Where a pseudo-random permutation of 0 to count - 1, of which there is one for each seed, puts some numbers.

    A Feistel network (Luby and Rackoff, 1988) on two digits of the numbers, in bases whose product is hardly more than
    the count, applied again to what lies beyond it (cycle walking; Black and Rogaway, 2002): no table, and each number
    as fast as any other. Raises ValueError for numbers that are not below the count.
    """
    least, most = (int(numbers.min()), int(numbers.max())) if len(numbers) else (0, 0)
    if least < 0 or most >= count > 0:
        raise ValueError(f"numbers reach from {least} to {most}, but must be 0 to {count - 1}")
    high = max(math.isqrt(max(count - 1, 0)) + 1, 1)
    bases = high, max(-(-count // high), 1)
    found, beyond = numbers.clone(), torch.arange(len(numbers), device=numbers.device)
    while len(beyond):
        found[beyond] = _network(found[beyond], bases, seed)
        beyond = beyond[found[beyond] >= count]
    return found


def _network(numbers: Int[Tensor, " n"], bases: tuple[int, int], seed: int) -> Int[Tensor, " n"]:
    digits = [numbers // bases[1], numbers % bases[1]]
    for number in range(ROUNDS):
        one, other = number % 2, 1 - number % 2
        key = ((seed & 0xFFFFFFFF) << 20) + number
        digits[one] = (digits[one] + _mixed(digits[other] + key)).remainder(bases[one])
    return digits[0] * bases[1] + digits[1]


def _mixed(numbers: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    for _ in range(2):
        numbers = numbers * ODD
        numbers = numbers ^ (numbers >> SHIFT)
    return numbers
