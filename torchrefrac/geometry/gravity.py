"""The split of a rotation into what gravity determines and the heading (paper, section 3.4).

`cam_from_world = cam_from_level @ heading_rotation(heading)`: the level frame has z up and is turned about
the vertical so that a camera looking straight down needs no further rotation than a flip.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def level_rotation(down_in_cam: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """`cam_from_level` for unit gravity directions: R_ver of the paper.

    It is the shortest turn of the optical axis onto `down_in_cam`, after the flip diag(1, -1, -1) that maps
    world "down" onto the optical axis. Undefined only for a camera that looks at the zenith.
    """
    x, y, z = down_in_cam.unbind(dim=-1)
    k = 1.0 / (1.0 + z)
    rows = (1.0 - k * x * x, k * x * y, -x, -k * x * y, k * y * y - 1.0, -y, -x, y, -z)
    return torch.stack(rows, dim=-1).reshape(*down_in_cam.shape, 3)


def levelling(down: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Rotation of the world that takes the unit vector `down` to (0, 0, -1): the shortest, after half a turn about x
    where the world stands on its head."""
    flip = down.new_tensor((1.0, -1.0, -1.0))
    turn = torch.where(down[2] > 0.0, flip, flip.abs())
    return level_rotation(flip * turn * down).mT * (flip * turn)


def heading_rotation(heading: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation by `heading` radians about the vertical, `level_from_world`."""
    c, s = heading.cos(), heading.sin()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    rows = (c, -s, zero, s, c, zero, zero, zero, one)
    return torch.stack(rows, dim=-1).reshape(*heading.shape, 3, 3)


def split_heading(
    cam_from_world: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """`down_in_cam` and heading (radians) of rotations; inverts the product above."""
    down = -cam_from_world[..., 2]
    level_from_world = level_rotation(down).mT @ cam_from_world
    return down, torch.atan2(level_from_world[..., 1, 0], level_from_world[..., 0, 0])
