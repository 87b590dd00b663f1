"""What the camera's sensors say of its attitude and position."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry import so3_exp, split_heading
from torchrefrac.synthetic.options import InertialOptions, SyntheticOptions, seeded

DOWN_BEFORE_WALL = (0.0, -1.0, 0.0)  # gravity in the frame of a wall
LEAST_SIGMA_DEG = 0.05
MOST_SIGMA_DEG = 30.0


@dataclass(frozen=True, eq=False)
class Attitude:
    """Of m cameras: true_down and measured down_in_cam, unit vectors, the latter None where gravity is not measured;
    measured heading in radians, None without a compass; sigma_deg: what to expect of the error of down_in_cam about
    each axis, as an angle to the perpendicular of the water surface, or to -y before a wall."""

    true_down: Float[Tensor, "m 3"]
    down_in_cam: Float[Tensor, "m 3"] | None
    heading: Float[Tensor, " m"] | None
    sigma_deg: float


def measure_attitude(rotation: Float[Tensor, "m 3 3"], options: SyntheticOptions) -> Attitude:
    """What the sensors say of cameras with `cam_from_world` rotation.

    True gravity departs from the perpendicular of the water by `plane_tilt_deg`, the same way for all images; what is
    measured departs from it by the bias, in the camera's frame, and by an error of each image's own. The frame of a
    wall has no north, and its cameras no compass.
    """
    inertial = options.inertial
    tilt = so3_exp(torch.tensor((*options.plane_tilt_deg, 0.0), dtype=torch.float64).deg2rad())
    true_down, heading = split_heading(rotation @ tilt)
    sensed = None
    if options.interface.kind == "wall":
        true_down = rotation @ tilt @ torch.tensor(DOWN_BEFORE_WALL, dtype=torch.float64)
    elif inertial.heading_sigma_deg is not None:
        error = torch.randn(len(rotation), generator=seeded(options.seed, "heading"), dtype=torch.float64)
        sensed = heading + math.radians(inertial.heading_sigma_deg) * error
    sigma_deg = inertial.gravity_sigma_deg
    if sigma_deg is None:
        return Attitude(true_down, None, sensed, math.inf)
    fixed = (*inertial.gravity_bias_deg, *options.plane_tilt_deg)
    measured = _measured(true_down, inertial, sigma_deg, options.seed)
    return Attitude(true_down, measured, sensed, _expected_sigma_deg(sigma_deg, fixed))


def _measured(
    true_down: Float[Tensor, "m 3"], inertial: InertialOptions, sigma_deg: float, seed: int
) -> Float[Tensor, "m 3"]:
    """Directions of gravity with the bias, and with errors of sigma_deg across them."""
    bias = so3_exp(torch.tensor((*inertial.gravity_bias_deg, 0.0), dtype=torch.float64).deg2rad())
    down = true_down @ bias.mT
    shaken = torch.randn(down.shape, generator=seeded(seed, "gravity"), dtype=torch.float64)
    shaken = math.radians(sigma_deg) * shaken
    across = shaken - (shaken * down).sum(dim=-1, keepdim=True) * down
    return torch.nn.functional.normalize((so3_exp(across) @ down[..., None])[..., 0], dim=-1)


def measure_positions(center: Float[Tensor, "m 3"], sigma: float, seed: int) -> Float[Tensor, "m 3"]:
    """Satellite positions of cameras at center, each coordinate with standard deviation sigma."""
    error = torch.randn(center.shape, generator=seeded(seed, "positions"), dtype=torch.float64)
    return center + sigma * error


def _expected_sigma_deg(sigma_deg: float, fixed_deg: tuple[float, ...]) -> float:
    """Root mean square about one axis, of errors of each image and of all alike, within what captures may say."""
    fixed = sum(angle**2 for angle in fixed_deg) / 2.0
    return min(max(math.sqrt(sigma_deg**2 + fixed), LEAST_SIGMA_DEG), MOST_SIGMA_DEG)
