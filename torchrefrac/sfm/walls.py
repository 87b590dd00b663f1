"""Photographs through a wall: the reconstruction stands in the frame of the wall, in which its normal is what the
vertical is above water, and gravity lies in its plane.

Gravity fixes one of the two angles of a vertical wall's normal in a photograph, and refraction both: the normal is
searched for as a vertical that nobody measured is (see `vertical`), and what gravity knows better is taken from it.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.scene import Capture, CaptureError, Scene
from torchrefrac.scene.interfaces import WALL

UPRIGHT_DEG = 1.0
"""How far from vertical a wall is taken to be, where nobody says."""
FARTHEST_DEG = 75.0
"""From the normal of a wall that photographs look at."""


def looks_through_wall(capture: Capture) -> bool:
    """Whether any photograph does."""
    return WALL in capture.interfaces.kinds


def facing_wall(capture: Capture) -> Capture:
    """The capture with the directions into the wall, where they are stated, in the place of gravity.

    Raises CaptureError where gravity says that the photographs look along the wall.
    """
    if not looks_through_wall(capture):
        return capture
    known = capture.down_sigma.isfinite()
    steep = capture.down_in_cam[known, 2].abs() > math.sin(math.radians(FARTHEST_DEG))
    if bool(steep.any()):
        name = [name for name, has in zip(capture.names, known.tolist(), strict=True) if has][int(steep.int().argmax())]
        raise CaptureError(
            f"{name} looks up or down, by its down_in_cam, but the interface is a wall, which stands upright; check "
            "down_in_cam, or state kind 'surface'"
        )
    return replace(
        capture,
        down_in_cam=-capture.normal_in_cam,
        down_sigma=capture.normal_sigma,
        has_gravity=bool(capture.normal_sigma.isfinite().any()),
    )


def with_upright_wall(facing: Capture, stated: Capture) -> Capture:
    """The capture `facing` a wall with directions into it that are level, as far as the gravity of `stated` knows it
    better than they are known."""
    if not looks_through_wall(stated) or not stated.has_gravity:
        return facing
    gravity, into = stated.down_in_cam, facing.down_in_cam
    upright = torch.hypot(stated.down_sigma, stated.down_sigma.new_tensor(math.radians(tilt_sigma_deg(stated))))
    doubt = facing.down_sigma.clamp(max=math.pi).square()
    share = torch.where(upright.isfinite(), doubt / (doubt + upright.square()), 0.0)
    along = (gravity * into).sum(dim=-1)
    level = torch.nn.functional.normalize(into - (share * along)[:, None] * gravity, dim=-1)
    return replace(facing, down_in_cam=level)


def tilt_sigma_deg(capture: Capture) -> float:
    """How far from vertical the walls of a capture may be, degrees."""
    return math.degrees(capture.interfaces.sigmas.get("upright", math.radians(UPRIGHT_DEG)))


def gravity_in_world(scene: Scene, stated: Capture) -> Float[Tensor, "3"] | None:
    """The mean of the gravity that is stated of registered views, a unit vector in the frame of the wall; None where
    there is none."""
    rows = scene.views.registered & stated.down_sigma.isfinite()
    if not bool(rows.any()):
        return None
    turned = scene.views.rotation[rows].mT @ stated.down_in_cam[rows, :, None]
    weighed = turned[..., 0] / stated.down_sigma[rows, None].square()
    return torch.nn.functional.normalize(weighed.sum(dim=0), dim=0)
