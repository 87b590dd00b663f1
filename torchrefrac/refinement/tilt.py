"""Poses near a measured vertical, cam_from_world = cam_from_level exp([t]x) R_z(heading), and what is known of them
beside pixels: gravity, the heading, and that a camera stands above the water.

t = (t_x, t_y, 0) is the error of the measured vertical, a turn about a horizontal axis, in radians. A prior on gravity
is one on the length of t, and t = 0 is what the solvers with known vertical find. Models of poses are rows (tilts,
heading, centre) with two tilts a camera, the centre being that of the last camera.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import can_be_looked_at
from torchrefrac.geometry import heading_rotation
from torchrefrac.optim import Quadratic

Sigma = float | Float[Tensor, " k"]
Limit = float | Float[Tensor, " k"]


@dataclass(frozen=True)
class Cost:
    """Poses as `SmallProblems`, of which all that is known is their quadratic models."""

    model: Callable[[Float[Tensor, "k d"]], Quadratic]

    def linearize(self, states: Float[Tensor, "k d"]) -> Quadratic:
        return self.model(states)


def beside(limit: Limit, like: Float[Tensor, "k n"]) -> Float[Tensor, "*k 1"]:
    """A limit of the errors of all models, or of each, beside these errors."""
    return torch.as_tensor(limit, dtype=like.dtype, device=like.device)[..., None]


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


def with_priors(
    models: Float[Tensor, "k d"], quadratic: Quadratic, gravity_sigma: Sigma, pixel_sigma: float, known_heading: bool
) -> Quadratic:
    """The cost of models in squared pixels with gravity as a prior on the tilts.

    gravity_sigma, of all models or of each: 0 fixes the tilts; known_heading the heading: their part of the quadratic
    model becomes the identity. A camera below the water costs infinitely much.
    """
    cost, gradient, hessian = quadratic
    tilts = models.shape[-1] - 4
    weight = _weights(models, gravity_sigma, pixel_sigma)
    if weight is not None:
        gradient, hessian = gradient + weight * models, hessian + torch.diag_embed(weight)
    exact = torch.as_tensor(gravity_sigma, device=models.device) == 0.0
    if known_heading or (can_be_looked_at(models) and bool(exact.any())):
        free = torch.ones_like(models)
        free[:, :tilts] = (~exact).to(models)[..., None].expand(len(models), tilts)
        free[:, tilts] = float(not known_heading)
        gradient = gradient * free
        hessian = hessian * free[:, :, None] * free[:, None] + torch.diag_embed(1.0 - free)
    return Quadratic(cost + prior_costs(models, gravity_sigma, pixel_sigma), gradient, hessian)


def prior_costs(models: Float[Tensor, "k d"], gravity_sigma: Sigma, pixel_sigma: float) -> Float[Tensor, " k"]:
    """What the priors add to the costs of models, in squared pixels, half a sum."""
    weight = _weights(models, gravity_sigma, pixel_sigma)
    tilted = 0.0 if weight is None else 0.5 * (weight * models.square()).sum(dim=-1)
    return torch.where(models[:, -1] > 0.0, tilted, torch.inf)


def _weights(models: Float[Tensor, "k d"], gravity_sigma: Sigma, pixel_sigma: float) -> Float[Tensor, "*k d"] | None:
    """Of the squares of the unknowns: those of the tilts. None where gravity is exact or unknown of all models."""
    tilts = models.shape[-1] - 4
    if isinstance(gravity_sigma, Tensor):
        weight = torch.zeros_like(models)
        known = (gravity_sigma > 0.0) & gravity_sigma.isfinite()
        of_each = torch.where(known, pixel_sigma / torch.where(known, gravity_sigma, 1.0), 0.0).square()
        weight[:, :tilts] = of_each.to(models)[..., None].expand(len(models), tilts)
        return weight
    if not 0.0 < gravity_sigma < float("inf"):
        return None
    weight = torch.zeros_like(models[0])
    weight[:tilts] = (pixel_sigma / gravity_sigma) ** 2
    return weight
