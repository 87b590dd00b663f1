"""Back projection: rays bent at the water surface (Chang & Chen, ICCV 2011, Eq. 6 to 9)."""

import torch
from torch import Tensor


def refract_rays(center: Tensor, direction: Tensor, index_ratio: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Follow viewing rays through the surface z = 0.

    center (*B, 3), above the water; direction (*B, 3) in air, of any length; index_ratio broadcasts.
    Returns the refrax on the surface (*B, 3), the unit direction in the water (*B, 3), and a mask (*B):
    False where the ray does not go down or the centre is not above the water. There the ray is returned as it
    came, from the centre.
    """
    center, direction, _ = torch.broadcast_tensors(center, direction, index_ratio[..., None])
    unit = torch.nn.functional.normalize(direction, dim=-1)
    valid = (unit[..., 2] < 0) & (center[..., 2] > 0)
    down = torch.where(valid, unit[..., 2], -1.0)
    refrax = center - (center[..., 2] / down)[..., None] * unit
    refrax = torch.cat((refrax[..., :2], torch.zeros_like(refrax[..., :1])), dim=-1)
    horizontal = unit[..., :2] / index_ratio[..., None]
    vertical = -(down.square() + (index_ratio - 1.0) * (index_ratio + 1.0)).sqrt() / index_ratio
    bent = torch.cat((horizontal, vertical[..., None]), dim=-1)
    keep = valid[..., None]
    return torch.where(keep, refrax, center), torch.where(keep, bent, unit), valid
