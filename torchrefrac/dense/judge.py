"""Whether to believe an adjusted patch, and how precise it is."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.photometric import Agreement, Comparison
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.window import CORNERS, Window
from torchrefrac.optim.batched import Quadratic, solve_damped

SYSTEMATIC = 0.03  # pixels: what interpolation and poses leave however good the texture is


class Subjects(NamedTuple):
    """What is known of n patches before they are adjusted: pixels in the reference, the rays (n) through them, and the
    contrast of their windows, in grey levels."""

    pixels: Float[Tensor, "n 2"]
    rays: PixelRays
    contrast: Float[Tensor, " n"]


def judge(
    scope: Scope,
    subjects: Subjects,
    comparison: Comparison,
    agreement: Agreement,
    states: Float[Tensor, "n 3"],
    options: DenseOptions,
) -> tuple[Patches, Int[Tensor, " k"]]:
    """Of n patches at `states`, those to be believed and their numbers, as they agree there or very near.

    Enough images must agree, the patch must face the camera, lie between near and far, and be determined: sigma times
    the motion in the other images stays below `max_sigma` pixels.
    """
    visible = agreement.usable & (agreement.zncc >= options.min_score)
    count = visible.sum(dim=1)
    score = (torch.where(visible, agreement.zncc, 0.0).sum(dim=1) / count.clamp(min=1)).to(states)
    motion = torch.where(visible, agreement.motion, 0.0).amax(dim=1)
    photometric, determined = _sigma(
        agreement, visible, score, subjects.contrast.to(states), comparison.window, options
    )
    sigma = torch.hypot(photometric, SYSTEMATIC / motion.clamp(min=torch.finfo(motion.dtype).tiny))
    corners = comparison.corners(states)
    middle, normal = plane_through(corners)
    distance = subjects.rays.meet(middle, normal)
    sight = subjects.rays.direction_at(distance)
    facing = -(normal * sight).sum(dim=-1)
    good = (
        determined
        & (count >= fewest_others(scope, options))
        & (facing.abs() > math.cos(math.radians(options.max_slant)))
        & (sigma * motion < options.max_sigma)
        & (distance > scope.near)
        & (distance < scope.far)
    ).nonzero()[:, 0]
    patches = Patches(
        reference=scope.ids[0].expand(len(states)),
        pixels=subjects.pixels,
        points=subjects.rays.at(distance),
        normals=normal * torch.sign(facing)[:, None],
        sigma=sigma,
        footprint=_footprint(corners, sight, comparison.window),
        score=score,
        others=scope.ids[comparison.image],
        visible=visible,
    )
    return patches[good], good


def fewest_others(scope: Scope, options: DenseOptions) -> int:
    """How many other images must agree: fewer where the reference has fewer to compare with."""
    return max(1, min(options.min_views - 1, scope.others))


def plane_through(corners: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """A point of the plane through three points, and its unit normal of either sign."""
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(dim=1), torch.nn.functional.normalize(normal, dim=-1)


def _sigma(
    agreement: Agreement,
    visible: Bool[Tensor, "n v"],
    score: Float[Tensor, " n"],
    contrast: Float[Tensor, " n"],
    window: Window,
    options: DenseOptions,
) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Standard deviation of the distances from noise, and where the images determine all of a patch.

    The variance of the residuals f^ - g^, each sample's, is what is left of them, but at least what `noise` grey levels
    in both windows make. One half is the reference's own, which all images share: with the derivatives J_v of g^_v and
    H = sum J_v^T J_v, the covariance is H^-1 (H + (sum J_v)^T (sum J_v)) H^-1 / 2 times that variance.
    """
    samples = window.size**2
    freedom = samples - 2 - CORNERS / visible.sum(dim=1).clamp(min=1)
    left = 2.0 * (1.0 - score) / freedom
    floor = 2.0 * (options.noise / contrast.clamp(min=options.min_contrast)).square() / samples
    hessian = torch.where(visible[..., None, None], agreement.hessian, 0.0).sum(dim=1).to(score)
    first = torch.zeros_like(hessian[:, 0])
    first[:, 0] = 1.0
    of_distance = solve_damped(Quadratic(score, -first, hessian), torch.zeros_like(score))  # a column of the inverse
    shared = agreement.change(of_distance.to(agreement.vectors), visible, window).square().sum(dim=-1).to(score)
    variance = 0.5 * torch.maximum(left, floor) * (of_distance[:, 0] + shared)
    return variance.sqrt(), of_distance[:, 0] > 0.0


def _footprint(corners: Float[Tensor, "n 3 3"], sight: Float[Tensor, "n 3"], window: Window) -> Float[Tensor, " n"]:
    """How far one reference pixel reaches across the line of sight, from the corners' spread."""
    spread = corners - corners.mean(dim=1, keepdim=True)
    across = spread - (spread * sight[:, None]).sum(dim=-1, keepdim=True) * sight[:, None]
    return across.square().sum(dim=-1).mean(dim=-1).sqrt() / window.radius
