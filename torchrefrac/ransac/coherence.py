"""Whether some of a pair's matches are right, seen before any pose is known.

What lies side by side in one image lies side by side in the other, whatever the cameras and the water do. Neighbours of
wrong matches go anywhere (Bian et al., "GMS", CVPR 2017). How many neighbours are shared by chance, wherever in both
images keypoints are crowded, is what the same places show when they are matched at random.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

NEIGHBOURS = 6
LOOKED_AT = 400
SHUFFLES = 32
CLEAR = 1.5
"""Standard deviations by which more neighbours are shared than by chance: eight wrong pairs in a hundred have as many.
Of a hundred matches thirty right ones give five or six on average."""


def are_coherent(plane1: Float[Tensor, "n 2"], plane2: Float[Tensor, "n 2"]) -> bool:
    """Whether matches share clearly more neighbours in both images than the same places matched at random.

    Looks at up to LOOKED_AT of them, drawn at random, but always at the same.
    """
    count = len(plane1)
    generator = torch.Generator().manual_seed(0)
    rows = torch.randperm(count, generator=generator)[:LOOKED_AT].to(plane1.device)
    first, second = plane1[rows], plane2[rows]
    if len(rows) <= NEIGHBOURS:
        return True
    next_to = _neighbours(second)
    are_next = torch.zeros(len(rows), len(rows), dtype=torch.bool, device=plane1.device).scatter_(1, next_to, True)
    at_random = torch.rand(SHUFFLES, len(rows), generator=generator).argsort(dim=-1).to(plane1.device)
    orders = torch.cat((torch.arange(len(rows), device=plane1.device)[None], at_random))
    shared = are_next[orders[:, :, None], orders[:, _neighbours(first)]].sum(dim=(1, 2)).double()
    by_chance = shared[1:]
    return bool(shared[0] > by_chance.mean() + CLEAR * by_chance.std())


def _neighbours(places: Float[Tensor, "n 2"]) -> Int[Tensor, "n k"]:
    """The nearest other places of each."""
    distances = torch.cdist(places, places).fill_diagonal_(torch.inf)
    return distances.topk(NEIGHBOURS, largest=False).indices
