"""Which way a camera was turned: from angles that devices write to gravity and heading.

A body's axes are forward, right and down; it is turned from north, east and down by yaw, then pitch, then roll:
clockwise as seen from above, nose up, right side down. A gimbal's camera looks forward along it; one that is mounted
in an aircraft looks down, the top of its image forward.
"""

import math
from dataclasses import dataclass
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry import split_heading

NORTH_EAST_DOWN_FROM_WORLD = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))  # world: east, north, up


class Mount(Enum):
    """`cam_from_body`: the rows are right, down and forward of the camera in the axes of the body."""

    FORWARD = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    DOWN = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Attitude:
    """down_in_cam of the image as stored, and the heading of its top once it is level, in degrees clockwise from true
    north (None: not known). sigma_deg: of gravity about each axis. source: what said so."""

    down_in_cam: tuple[float, float, float]
    heading_deg: float | None
    sigma_deg: float
    source: str

    @classmethod
    def of_angles(
        cls, yaw: float, pitch: float, roll: float, sigma_deg: float, source: str, mount: Mount = Mount.FORWARD
    ) -> "Attitude":
        """From degrees."""
        turned = cam_from_world(*torch.tensor((yaw, pitch, roll), dtype=torch.float64).deg2rad().unbind(), mount=mount)
        down, heading = split_heading(turned)
        x, y, z = down.tolist()
        return cls((x, y, z), math.degrees(float(heading)) % 360.0, sigma_deg, source)

    @property
    def half_turned(self) -> "Attitude":
        """Of the same image stored upside down."""
        x, y, z = self.down_in_cam
        heading = None if self.heading_deg is None else (self.heading_deg + 180.0) % 360.0
        return Attitude((-x, -y, z), heading, self.sigma_deg, self.source)


def body_from_north_east_down(
    yaw: Float[Tensor, "*batch"], pitch: Float[Tensor, "*batch"], roll: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3 3"]:
    """Radians."""
    (cy, sy), (cp, sp), (cr, sr) = ((angle.cos(), angle.sin()) for angle in (yaw, pitch, roll))
    forward = (cp * cy, cp * sy, -sp)
    right = (sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp)
    down = (cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp)
    return torch.stack((*forward, *right, *down), dim=-1).reshape(*yaw.shape, 3, 3)


def cam_from_world(
    yaw: Float[Tensor, "*batch"],
    pitch: Float[Tensor, "*batch"],
    roll: Float[Tensor, "*batch"],
    mount: Mount = Mount.FORWARD,
) -> Float[Tensor, "*batch 3 3"]:
    """Radians; world: x east, y north, z up."""
    cam_from_body, down_from_world = (yaw.new_tensor(rows) for rows in (mount.value, NORTH_EAST_DOWN_FROM_WORLD))
    return cam_from_body @ body_from_north_east_down(yaw, pitch, roll) @ down_from_world


def angles_of(
    cam_from_world: Float[Tensor, "*batch 3 3"], mount: Mount = Mount.FORWARD
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Yaw, pitch and roll, radians: the inverse of the function above."""
    cam_from_body, down_from_world = (
        cam_from_world.new_tensor(rows) for rows in (mount.value, NORTH_EAST_DOWN_FROM_WORLD)
    )
    body = cam_from_body.mT @ cam_from_world @ down_from_world.mT
    forward, side, belly = body.unbind(dim=-2)
    yaw, roll = torch.atan2(forward[..., 1], forward[..., 0]), torch.atan2(side[..., 2], belly[..., 2])
    return yaw, -forward[..., 2].clamp(-1.0, 1.0).asin(), roll


def as_stored(shown: tuple[float, float, float], orientation: int) -> tuple[float, float, float] | None:
    """A vector in the axes of the image as it is shown, in those of the image as stored, by the EXIF orientation; None
    where the image is mirrored."""
    x, y, z = shown
    return {1: (x, y, z), 3: (-x, -y, z), 6: (y, -x, z), 8: (-y, x, z)}.get(orientation)
