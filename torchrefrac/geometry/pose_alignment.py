"""How two frames lie to each other by the poses that views have in both, some of which may be wrong."""

from enum import Enum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry.alignment import Similarity
from torchrefrac.geometry.gravity import heading_rotation
from torchrefrac.geometry.rigid import Rigid
from torchrefrac.geometry.rotation import nearest_rotation, so3_log
from torchrefrac.numerics import thin

TRIED = 2000


class Freedom(Enum):
    """What may differ between two frames: LEVEL leaves the plane z = 0 of both where it is (place in it, heading and
    scale), RIGID the scale, SIMILARITY nothing."""

    LEVEL = "level"
    RIGID = "rigid"
    SIMILARITY = "similarity"

    @property
    def poses(self) -> int:
        """How many poses determine it: without scale and plane two, whose distance gives the scale."""
        return 2 if self is Freedom.SIMILARITY else 1


class PoseAlignment(NamedTuple):
    """b_from_a, and the views that agree with it."""

    b_from_a: Similarity
    agreeing: Bool[Tensor, " n"]


def align_poses(
    in_a: Rigid, in_b: Rigid, freedom: Freedom, reach: float | Float[Tensor, ""], max_angle: float
) -> PoseAlignment | None:
    """By most of the poses cam_from_a (n) and cam_from_b (n) of the same cameras: the mean of those that agree with the
    one, or the two, with which most do. None where they are fewer than the freedom needs.

    A view agrees whose rotation, in radians, and whose centre, as seen from as far as `reach` (in b), are together off
    by max_angle at most.
    """
    count = len(in_a)
    chosen = thin(torch.combinations(torch.arange(count), freedom.poses), TRIED)
    if not len(chosen):
        return None
    weight = torch.zeros(len(chosen), count, dtype=torch.float64).scatter_(1, chosen, 1.0).to(in_a.center)
    off = _off(in_a, in_b, *_aligned(in_a, in_b, weight, freedom), reach)
    agreeing = off <= max_angle
    best = (agreeing.sum(dim=1) - off.clamp(max=max_angle).mean(dim=1) / max_angle).argmax()
    weight = torch.maximum(weight[best], agreeing[best].to(weight))
    scale, rotation, translation = _aligned(in_a, in_b, weight[None], freedom)
    return PoseAlignment(Similarity(scale[0], rotation[0], translation[0]), agreeing[best])


def _aligned(
    in_a: Rigid, in_b: Rigid, weight: Float[Tensor, "h n"], freedom: Freedom
) -> tuple[Float[Tensor, " h"], Float[Tensor, "h 3 3"], Float[Tensor, "h 3"]]:
    """Scales, rotations and translations of the means of some poses: the rotation is that of their axes, the others
    follow by least squares from their centres."""
    axes = torch.einsum("hn,nij->hij", weight, in_b.rotation.mT @ in_a.rotation)
    if freedom is Freedom.LEVEL:
        rotation = heading_rotation(torch.atan2(axes[:, 1, 0] - axes[:, 0, 1], axes[:, 0, 0] + axes[:, 1, 1]))
    else:
        rotation = nearest_rotation(axes)
    turned = torch.einsum("hij,nj->hni", rotation, in_a.center)
    share = weight / weight.sum(dim=1, keepdim=True)
    middles = [(share[..., None] * center).sum(dim=1) for center in (turned, in_b.center)]
    if freedom is Freedom.LEVEL:  # heights count from the plane
        middles = [middle * middle.new_tensor((1.0, 1.0, 0.0)) for middle in middles]
    a, b = turned - middles[0][:, None], in_b.center - middles[1][:, None]
    across, spread = ((share[..., None] * a * other).sum(dim=(1, 2)) for other in (b, a))
    scale = across / torch.where(spread > 0.0, spread, 1.0)
    scale = torch.ones_like(scale) if freedom is Freedom.RIGID else scale
    return scale, rotation, middles[1] - scale[:, None] * middles[0]


def _off(
    in_a: Rigid,
    in_b: Rigid,
    scale: Float[Tensor, " h"],
    rotation: Float[Tensor, "h 3 3"],
    translation: Float[Tensor, "h 3"],
    reach: float | Float[Tensor, ""],
) -> Float[Tensor, "h n"]:
    """By how much poses differ under each of some similarities, as angles."""
    moved = scale[:, None, None] * (in_a.center @ rotation.mT) + translation[:, None]
    turn = in_b.rotation @ (rotation[:, None] @ in_a.rotation.mT)
    return (moved - in_b.center).norm(dim=-1) / reach + so3_log(turn).norm(dim=-1)
