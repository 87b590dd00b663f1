"""Random samples without repetition, batched."""

import torch
from jaxtyping import Int
from torch import Tensor


def draw_samples(count: int, num_data: int, size: int, generator: torch.Generator) -> Int[Tensor, "{count} {size}"]:
    """Uniform random subsets of 0 ... num_data - 1.

    Floyd's algorithm (Bentley & Floyd, CACM 1987): of the numbers up to j one is drawn, and j itself is taken in place
    of one that is in the sample already. On the device of the generator.
    """
    samples = torch.empty(count, size, dtype=torch.long, device=generator.device)
    for k in range(size):
        j = num_data - size + k
        drawn = torch.randint(j + 1, (count,), generator=generator, device=generator.device)
        taken = (samples[:, :k] == drawn[:, None]).any(dim=-1)
        samples[:, k] = torch.where(taken, j, drawn)
    return samples
