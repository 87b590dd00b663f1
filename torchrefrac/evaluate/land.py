"""Land must not change: what a reconstruction with refraction and one without it make of what lies above the water."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.geometry import align_similarity, rotate
from torchrefrac.numerics import first_of_each
from torchrefrac.scene import Scene

FEWEST = 3


def land_difference(scene: Scene, in_air: Scene) -> dict[str, float | int]:
    """How far points on land lie apart in two reconstructions of the same photographs, the second without refraction.

    Points are the same where they have an observation in common: the same pixel of the same photograph. Both scenes are
    compared in the frame of the positions where both stand in it, and else after aligning their cameras by a
    similarity. With UNIT the length unit: land_points_compared, land_difference_median_UNIT, land_difference_rms_UNIT,
    and land_rise_median_UNIT, by how much refraction makes land higher. Empty where fewer than three points or cameras
    are common.
    """
    ours, theirs = common_points(scene, in_air)
    land = _on_land(scene)[ours]
    ours, theirs = ours[land], theirs[land]
    moved = _in_frame_of(scene, in_air)
    if moved is None or len(ours) < FEWEST:
        return {}
    apart = scene.points[ours] - moved[theirs]
    distance, unit = apart.norm(dim=-1), scene.length_unit
    return {
        "land_points_compared": len(ours),
        f"land_difference_median_{unit}": float(distance.median()),
        f"land_difference_rms_{unit}": float(distance.square().mean().sqrt()),
        f"land_rise_median_{unit}": float(apart[:, 2].median()),
    }


def common_points(first: Scene, second: Scene) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """The placed points of two scenes of the same photographs that an accepted observation shows to be the same, each
    point of the first once."""
    row = {name: i for i, name in enumerate(first.views.names)}
    view = torch.tensor([row.get(name, -1) for name in second.views.names], dtype=torch.long)
    seen, other = first.observations[first.accepted], second.observations[second.accepted]
    keys = torch.cat(
        (
            torch.cat((seen.view[:, None].double(), seen.pixels), dim=-1),
            torch.cat((view[other.view][:, None].double(), other.pixels), dim=-1),
        )
    )
    group = torch.unique(keys, dim=0, return_inverse=True)[1]
    place = torch.full((int(group.max()) + 1 if len(group) else 0,), -1, dtype=torch.long)
    place[group[: len(seen)]] = seen.point
    ours = place[group[len(seen) :]]
    both = ours >= 0
    ours, theirs = ours[both], other.point[both]
    once = first_of_each(ours) == torch.arange(len(ours))
    return ours[once], theirs[once]


def _on_land(scene: Scene) -> Bool[Tensor, " n"]:
    """Points that no water is before."""
    return scene.above_water() | scene.outside_water()


def _in_frame_of(scene: Scene, other: Scene) -> Float[Tensor, "n 3"] | None:
    """The points of another scene in the frame of this one; None where too few cameras are common."""
    lowered, down = scene.assessment.lowered_by, other.assessment.lowered_by
    if lowered is not None and down is not None:
        level = rotate(other.assessment.level_from_world, other.points)
        moved = level + other.points.new_tensor((0.0, 0.0, down - lowered))
        return rotate(scene.assessment.level_from_world.mT, moved)
    row = {name: i for i, name in enumerate(other.views.names)}
    pairs = [(i, row[name]) for i, name in enumerate(scene.views.names) if name in row]
    pairs = [(i, j) for i, j in pairs if scene.views.registered[i] and other.views.registered[j]]
    if len(pairs) < FEWEST:
        return None
    ours, theirs = (torch.tensor(column) for column in zip(*pairs, strict=True))
    return align_similarity(other.views.center[theirs], scene.views.center[ours]).apply(other.points)
