"""Points lifted to where they appear to be: refraction as a change of the point, before any lens.

Seen from the centre c, the point p appears in the direction of `offset` = (p_xy - c_xy, -H). A pinhole that
looks along `offset` completes the exact projection of Chang & Chen, Eq. 21.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.refraction.snell import apparent_height, apparent_height_partials


class Lift(NamedTuple):
    """Apparent offsets and how their vertical part changes; the horizontal part is simply p_xy - c_xy.

    offset (*B, 3); H's derivatives: by_center_z, by_point_z, by_index (*B), by_horizontal (*B, 2) in p_xy.
    """

    offset: Tensor
    by_center_z: Tensor
    by_point_z: Tensor
    by_horizontal: Tensor
    by_index: Tensor


def lift_points(center: Tensor, points: Tensor, index_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """Apparent offset (*B, 3) of world points seen from `center` above z = 0, and a validity mask (*B).

    Points at z >= 0 lie in air and are seen where they are. An invalid entry (centre not above the water)
    gets the straight offset. At index ratio 1 the offset is p - c to the last bit and always valid.
    """
    straight, wet, terms = _terms(center, points, index_ratio)
    offset = _offset(straight, wet, apparent_height(*terms))
    return offset, _is_valid(center, offset, index_ratio)


def lift_with_partials(center: Tensor, points: Tensor, index_ratio: Tensor) -> tuple[Lift, Tensor]:
    """`lift_points` together with the closed-form derivatives of the vertical part."""
    straight, wet, terms = _terms(center, points, index_ratio)
    lifted = apparent_height(*terms)
    by_height, by_depth, by_distance_sq, by_index = apparent_height_partials(lifted, *terms)
    one, zero = torch.ones_like(lifted), torch.zeros_like(lifted)
    offset = _offset(straight, wet, lifted)
    lift = Lift(
        offset=offset,
        by_center_z=torch.where(wet, by_height, one),
        by_point_z=torch.where(wet, -by_depth, -one),
        by_horizontal=(2.0 * torch.where(wet, by_distance_sq, zero))[..., None] * straight[..., :2],
        by_index=torch.where(wet, by_index, zero),
    )
    return lift, _is_valid(center, offset, index_ratio)


def _terms(
    center: Tensor, points: Tensor, index_ratio: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Straight offset, mask of refracted points, and (height, depth, distance_sq, index) safe to solve."""
    straight = points - center
    depth = -points[..., 2]
    height, depth, index, horizontal_sq = torch.broadcast_tensors(
        center[..., 2], depth, index_ratio, straight[..., :2].square().sum(dim=-1)
    )
    wet = (depth > 0) & (height > 0) & (index > 1)
    safe_height = torch.where(wet, height, 1.0)
    safe_depth = torch.where(wet, depth, 0.0)
    return straight, wet, (safe_height, safe_depth, horizontal_sq, torch.where(wet, index, 1.0))


def _offset(straight: Tensor, wet: Tensor, lifted: Tensor) -> Tensor:
    vertical = torch.where(wet, -lifted, straight[..., 2])
    return torch.cat((straight[..., :2].expand(*vertical.shape, 2), vertical[..., None]), dim=-1)


def _is_valid(center: Tensor, offset: Tensor, index_ratio: Tensor) -> Tensor:
    return (center[..., 2] > 0) | (index_ratio <= 1) & torch.isfinite(offset[..., 2])
