"""Poses near a measured vertical, cam_from_world = cam_from_level exp([t]x) R_z(heading), and what is known of them
beside pixels: gravity, the heading, and that a camera stands above the water.

t = (t_x, t_y, 0) is the error of the measured vertical, a turn about a horizontal axis, in radians. A prior on gravity
is one on the length of t, and t = 0 is what the solvers with known vertical find. Models of poses are rows (tilts,
heading, centre) with two tilts a camera, the centre being that of the last camera.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import can_be_looked_at
from torchrefrac.geometry import heading_rotation
from torchrefrac.numerics import like
from torchrefrac.optim import Quadratic

Sigma = float | Float[Tensor, " k"]
Limit = float | Float[Tensor, " k"]


def beside(limit: Limit, errors: Float[Tensor, "k n"]) -> Float[Tensor, "*k 1"]:
    """A limit of the errors of all models, or of each, beside these errors."""
    return like(limit, errors)[..., None]


def tilted_rotation(
    cam_from_level: Float[Tensor, "*#batch 3 3"], tilt: Float[Tensor, "*#batch 2"], heading: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch 3 3"]:
    """Rotations cam_from_world of tilts and headings, radians."""
    return cam_from_level @ (_exp(tilt) @ heading_rotation(heading))


def tilt_and_heading(
    cam_from_level: Float[Tensor, "*#batch 3 3"], cam_from_world: Float[Tensor, "*#batch 3 3"]
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Tilt and heading of rotations; inverts `tilted_rotation` for tilts below pi."""
    level_from_world = cam_from_level.mT @ cam_from_world
    x, y, z = level_from_world[..., 2].unbind(dim=-1)
    length = torch.hypot(x, y)
    scale = torch.where(length > 0.0, torch.atan2(length, z) / torch.where(length > 0.0, length, 1.0), 1.0)
    tilt = scale[..., None] * torch.stack((-y, x), dim=-1)
    turn = _exp(-tilt) @ level_from_world
    return tilt, torch.atan2(turn[..., 1, 0], turn[..., 0, 0])


def turn_by_tilt(tilt: Float[Tensor, "*batch 2"], heading: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Derivative of a turn about the axes of the world, R <- R exp([w]x), in (t_x, t_y, heading).

    The right Jacobian of exp at t (Chirikjian, "Stochastic Models, Information Theory, and Lie Groups", vol. 2, 2012,
    section 10.6), turned by the heading.
    """
    x, y = tilt.unbind(dim=-1)
    angle_sq, sine, versine = _coefficients(x, y)
    s = (1.0 - sine) / angle_sq.clamp(min=torch.finfo(x.dtype).tiny)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    mixed = s * x * y
    rows = (1.0 - s * y * y, mixed, zero, mixed, 1.0 - s * x * x, zero, versine * y, -versine * x, one)
    return heading_rotation(heading).mT @ torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _exp(tilt: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues' formula about a horizontal axis."""
    x, y = tilt.unbind(dim=-1)
    angle_sq, sine, versine = _coefficients(x, y)
    mixed = versine * x * y
    up, right = sine * y, sine * x
    diagonal = 1.0 - versine * y * y, 1.0 - versine * x * x, 1.0 - versine * angle_sq
    rows = (diagonal[0], mixed, up, mixed, diagonal[1], -right, -up, right, diagonal[2])
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _coefficients(x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"]) -> tuple[Float[Tensor, "*batch"], ...]:
    """Squared angle a^2, sin(a) / a and (1 - cos(a)) / a^2, smooth at zero."""
    angle_sq = torch.addcmul(x * x, y, y)
    turns = (angle_sq + torch.finfo(x.dtype).tiny).sqrt() / torch.pi  # never at the corner of the root
    return angle_sq, torch.sinc(turns), 0.5 * torch.sinc(0.5 * turns).square()


class Priors(NamedTuple):
    """What is known of models beside pixels. A camera below the water costs infinitely much.

    weight: of the squares of the unknowns, in squared pixels; None where gravity says nothing. free: 0 for unknowns
    that stay as they are, whose part of a quadratic model becomes the identity, 1 for others; None where all are. Both
    are one row for all models, or one for each.
    """

    weight: Float[Tensor, "*k d"] | None
    free: Float[Tensor, "*k d"] | None

    @classmethod
    def of(
        cls,
        gravity_sigma: Sigma,
        pixel_sigma: float,
        known_heading: bool,
        unknowns: int,
        reference: Float[Tensor, "..."],
    ) -> "Priors":
        """gravity_sigma: of all models or of each; 0 fixes the tilts, infinity leaves them free. known_heading: whether
        the heading is fixed. reference: of the precision and the device of the models."""
        sigma, tilts = like(gravity_sigma, reference.double())[..., None], unknowns - 4
        known = (sigma > 0.0) & sigma.isfinite()
        number = torch.arange(unknowns, device=reference.device)
        weight = torch.where(known, pixel_sigma / torch.where(known, sigma, 1.0), 0.0).square() * (number < tilts)
        fixed = ((sigma == 0.0) & (number < tilts)) | ((number == tilts) & known_heading)
        nothing_said, nothing_fixed = (can_be_looked_at(sigma) and not bool(some.any()) for some in (known, fixed))
        dtype = reference.dtype
        return cls(None if nothing_said else weight.to(dtype), None if nothing_fixed else (~fixed).to(dtype))

    def costs(self, models: Float[Tensor, "k d"]) -> Float[Tensor, " k"]:
        """What they add to the costs of models, in squared pixels, half a sum."""
        tilted = 0.0 if self.weight is None else 0.5 * (self.weight * models.square()).sum(dim=-1)
        return torch.where(models[:, -1] > 0.0, tilted, torch.inf)

    def added_to(self, quadratic: Quadratic, models: Float[Tensor, "k d"]) -> Quadratic:
        """The quadratic models with these."""
        cost, gradient, hessian = quadratic
        if self.weight is not None:
            gradient = torch.addcmul(gradient, self.weight, models)
            hessian = hessian + torch.diag_embed(self.weight)
        if self.free is not None:
            gradient = gradient * self.free
            hessian = hessian * self.free[..., :, None] * self.free[..., None, :] + torch.diag_embed(1.0 - self.free)
        return Quadratic(cost + self.costs(models), gradient, hessian)
