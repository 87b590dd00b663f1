"""Random fields over a plane: sums of cosines of random directions, lengths and phases, which are nearly Gaussian
(Shinozuka and Jan, "Digital simulation of random processes and its applications", 1972)."""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

WAVES = 12
"""Of which a field is made."""


def random_gradient(
    place: Float[Tensor, "k 2"], group: Int[Tensor, " k"], length: float, generator: torch.Generator
) -> Float[Tensor, "2 k"]:
    """Gradients of random surfaces, one for each group of places, that change over `length`; their squared length has
    the mean one."""
    total, size = torch.zeros_like(place.T), 0.0
    for wave, value in _waves(place, group, length, generator):
        total += wave[:, None] * value
        size += float(wave.square().sum())
    return total * math.sqrt(2.0 / size)


def random_shift(
    place: Float[Tensor, "k 2"], group: Int[Tensor, " k"], length: float, generator: torch.Generator
) -> Float[Tensor, "2 k"]:
    """Vectors of two independent components, each of mean square one."""
    total = torch.zeros_like(place.T)
    for i in range(len(total)):
        for _, value in _waves(place, group, length, generator):
            total[i] += value
    return total * math.sqrt(2.0 / WAVES)


def _waves(
    place: Float[Tensor, "k 2"], group: Int[Tensor, " k"], length: float, generator: torch.Generator
) -> Iterator[tuple[Float[Tensor, " 2"], Float[Tensor, " k"]]]:
    """Wave vectors and what their waves are at all places; groups have the same ones with phases of their own."""
    groups = int(group.max()) + 1
    vectors = torch.randn(WAVES, 2, generator=generator, dtype=torch.float64) / length
    phases = 2.0 * math.pi * torch.rand(WAVES, groups, generator=generator, dtype=torch.float64)
    for vector, phase in zip(vectors.to(place), phases.to(place), strict=True):
        yield vector, (place @ vector + phase[group]).cos()
