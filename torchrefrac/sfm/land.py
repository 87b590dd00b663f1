"""Photographs that show more land than water. Poses come from the land then, as those of a pinhole with a known
vertical, and the water is found afterwards: its level, and which points are seen through it."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.numerics import thin
from torchrefrac.scene import Interfaces, Scene
from torchrefrac.sfm.dry_points import ENOUGH_VIEWS, FEWEST, LEAST_SHARE, evidence, find_dry, keypoint_sigma
from torchrefrac.sfm.rules import Rules

LEVELS, SAMPLE = 24, 2000
"""Levels of the water that are tried, twice as many among the heights of the points, and tracks that judge them."""


def flooded(scene: Scene, index_ratio: float, rules: Rules) -> Scene | None:
    """A level scene that was reconstructed without refraction, with water of this index ratio where its tracks show it;
    None where they do not.

    Each level is judged by how many tracks below it are clearly seen through water. Points of the others stay where
    they are; those seen through water have no place any more.
    """
    sigma, several = keypoint_sigma(scene), (scene.sightings() >= ENOUGH_VIEWS).nonzero()[:, 0]
    some = thin(several, SAMPLE)
    wanted = torch.zeros_like(scene.placed).index_fill(0, some, True)
    least = max(FEWEST, LEAST_SHARE * len(several)) * len(some) / max(len(several), 1)
    wet = replace(scene, interfaces=Interfaces.level(index_ratio), dry=None)
    best, most = None, least
    for level in _levels(scene):
        at = replace(wet, interfaces=replace(wet.interfaces, offset=level[None]))
        count = int(evidence(at, wanted, rules, sigma).clearly_wet.sum())
        if count > most:
            best, most = at, count
    if best is None:
        return None
    dry = find_dry(replace(best, dry=torch.zeros_like(scene.placed)), rules)
    wet = ~best.above_water() if dry is None else ~best.above_water() & ~dry
    accepted = best.accepted & ~wet[best.observations.point]
    return replace(best, dry=dry, placed=best.placed & ~wet, accepted=accepted)


def _levels(scene: Scene) -> Float[Tensor, " levels"]:
    """Between the lowest points and the highest: evenly, and more where there are more points."""
    height = scene.points[scene.placed][:, 2]
    share = torch.linspace(0.02, 0.98, LEVELS, dtype=height.dtype)
    low, high = height.aminmax()
    return torch.cat((height.quantile(share), low + (high - low) * share))
