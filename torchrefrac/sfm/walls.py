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
        gravity_in_cam=capture.down_in_cam,
        gravity_sigma=capture.down_sigma,
        down_in_cam=-capture.normal_in_cam,
        down_sigma=capture.normal_sigma,
        has_gravity=bool(capture.normal_sigma.isfinite().any()),
    )


def with_upright_wall(facing: Capture) -> Capture:
    """A capture that faces a wall with directions into it that are level, as far as gravity knows it better than they
    are known."""
    if not looks_through_wall(facing):
        return facing
    gravity, into = facing.gravity_in_cam, facing.down_in_cam
    upright = torch.hypot(facing.gravity_sigma, torch.full_like(facing.gravity_sigma, tilt_sigma(facing)))
    doubt = facing.down_sigma.clamp(max=math.pi).square()
    share = torch.where(upright.isfinite(), doubt / (doubt + upright.square()), 0.0)
    along = (gravity * into).sum(dim=-1)
    level = torch.nn.functional.normalize(into - (share * along)[:, None] * gravity, dim=-1)
    return replace(facing, down_in_cam=level)


def tilt_sigma(capture: Capture) -> float:
    """How far from vertical the walls of a capture may be, radians."""
    return capture.interfaces.sigmas.get("upright", math.radians(UPRIGHT_DEG))


def gravity_in_world(scene: Scene, facing: Capture) -> tuple[Float[Tensor, "3"], float] | None:
    """The mean gravity of registered views, a unit vector in the frame of the wall, and its standard deviation in
    radians; None where there is none."""
    sigma, rows = facing.gravity_sigma, scene.views.registered & facing.gravity_sigma.isfinite()
    if not looks_through_wall(facing) or not bool(rows.any()):
        return None
    turned = (scene.views.rotation[rows].mT @ facing.gravity_in_cam[rows, :, None])[..., 0]
    weighed = (turned / sigma[rows, None].square()).sum(dim=0)
    return torch.nn.functional.normalize(weighed, dim=0), float(sigma[rows].square().reciprocal().sum().rsqrt())
