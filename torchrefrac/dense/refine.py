"""From a guess to a patch: which images to compare with, the photometric adjustment, and whether to believe it."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.photometric import Comparison, unit_windows
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.window import CORNERS, Window
from torchrefrac.optim.batched import covariance_of, minimize_each

TOLERANCE = 1e-3  # of the cost: an adjustment ends within a fifth of a standard deviation
MIN_SCALE = 0.4  # of an image against the reference: one that shows the surface smaller than this is not compared


class Planes(NamedTuple):
    """Guesses of N patches: points and normals (N, 3) in the world frame; the normals of any length and either sign."""

    points: Tensor
    normals: Tensor

    def __getitem__(self, rows: Tensor) -> "Planes":  # type: ignore[override]
        return Planes(self.points[rows], self.normals[rows])


def refine(
    scope: Scope, pixels: Tensor, planes: Planes, options: DenseOptions, start_level: int = 0
) -> tuple[Patches, Tensor]:
    """Adjust patches centred at reference pixels (N, 2) from `planes` (N), in batches.

    Returns those that are to be believed and which of the N they are. start_level: first adjust in copies halved so many
    times, for guesses that are off by several pixels.
    """
    parts, kept = [Patches.empty(min(options.views, scope.others))], [torch.zeros(0, dtype=torch.long)]
    for first in range(0, len(pixels), options.batch):
        rows = slice(first, first + options.batch)
        patches, good = _refine_batch(scope, pixels[rows], Planes(*(p[rows] for p in planes)), options, start_level)
        parts.append(patches)
        kept.append(good + first)
    return Patches.together(parts), torch.cat(kept)


def _refine_batch(
    scope: Scope, pixels: Tensor, planes: Planes, options: DenseOptions, start_level: int
) -> tuple[Patches, Tensor]:
    reference = scope.cameras[0]
    window = Window(options.window)
    middle = PixelRays.cast(reference, pixels)
    # The reference must show texture.
    zero = torch.zeros(len(pixels), dtype=torch.long)
    f, contrast = unit_windows(scope.atlas, zero, zero, pixels, window)
    distance = middle.meet(planes.points, planes.normals)
    lies = (contrast >= options.min_contrast) & (distance > scope.near) & (distance < scope.far)
    rows = (lies & scope.is_allowed(zero, pixels)).nonzero()[:, 0]
    pixels, planes, f, middle = pixels[rows], planes[rows], f[rows], middle[rows]
    image, present = choose_views(scope, middle.at(distance[rows]), options)
    enough = (present.sum(dim=1) >= _fewest(scope, options)).nonzero()[:, 0]
    rows, pixels, planes, f, middle = rows[enough], pixels[enough], planes[enough], f[enough], middle[enough]
    image, present, contrast = image[enough], present[enough], contrast[rows]
    points, normals = planes
    for level in range(start_level, -1, -1):
        w = Window(options.window, 2.0**level)
        corners = PixelRays.cast(reference, pixels[:, None] + w.corners)
        states = corners.meet(points[:, None], normals[:, None]) @ torch.linalg.inv(w.basis).T
        if level:
            base = torch.full((len(pixels),), level)
            f_level, _ = unit_windows(scope.atlas, torch.zeros_like(base), base, pixels, w)
        else:
            f_level = f
        comparison = Comparison(
            scope.cameras, scope.atlas, w, corners, f_level, image, torch.zeros_like(image), present, options.loss_scale
        )
        comparison = comparison.at_matching_levels(states, level, MIN_SCALE)
        report = minimize_each(comparison, states, options.iterations, TOLERANCE)
        points, normals = _plane_of(corners.at(report.states @ w.basis.T))
        states = report.states
    return _believed(scope, rows, pixels, middle, comparison, report, contrast, options)


def choose_views(scope: Scope, points: Tensor, options: DenseOptions) -> tuple[Tensor, Tensor]:
    """For points (N, 3), the local images (N, V) to compare with, best first, and which of these will do (N, V).

    One that sees the point within its image, at an angle near the best.
    """
    cameras = scope.cameras
    local = torch.arange(1, 1 + scope.others)
    pixels, seen = cameras[1:, None].project(points)
    seen = seen & scope.is_allowed(local[:, None].expand(seen.shape), pixels)
    sight = torch.nn.functional.normalize(cameras.center_in_world[:, None] - points, dim=-1)
    cosine = (sight[1:] * sight[0]).sum(dim=-1).clamp(-1.0, 1.0)
    angle = torch.rad2deg(torch.acos(cosine))
    fits = torch.minimum(angle / options.angle_best, options.angle_best / angle.clamp(min=1e-6))
    fits = torch.where(seen & (angle > 1.0) & (angle < options.angle_max), fits, 0.0)
    best = fits.T.topk(min(options.views, scope.others), dim=1)
    return local[best.indices], best.values > 0.0


def _fewest(scope: Scope, options: DenseOptions) -> int:
    """Other images that must agree."""
    return max(1, min(options.min_views - 1, scope.others))


def _plane_of(corners: Tensor) -> tuple[Tensor, Tensor]:
    """A point of the plane through points (N, 3, 3), and its unit normal; both (N, 3)."""
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(dim=1), torch.nn.functional.normalize(normal, dim=-1)


def _believed(scope, rows, pixels, middle, comparison, report, contrast, options):
    window = comparison.window
    agreement = comparison.agreement(report.states)
    visible = agreement.usable & (agreement.zncc >= options.min_score)
    count = visible.sum(dim=1)
    score = torch.where(visible, agreement.zncc, 0.0).sum(dim=1) / count.clamp(min=1)
    corners = comparison.rays.at(report.states @ window.basis.T)
    point, normal = _plane_of(corners)
    distance = middle.meet(point, normal)
    points = middle.at(distance)
    sight = middle.direction_at(distance)
    normal = normal * -torch.sign((normal * sight).sum(dim=-1, keepdim=True))
    slant = -(normal * sight).sum(dim=-1)
    weight = visible.to(agreement.hessian)
    hessian = (weight[..., None, None] * agreement.hessian).sum(dim=1)
    # noise
    freedom = window.size**2 - 2 - CORNERS / count.clamp(min=1)
    residual = 2.0 * (1.0 - score) / freedom
    floor = 2.0 * (options.noise / contrast).square() / window.size**2
    variance = torch.maximum(residual.double(), floor.double())
    covariance, exists = covariance_of(hessian.double())
    sigma = (variance * covariance[:, 0, 0]).sqrt()
    _, along = comparison.corner_pixels(report.states)
    shift = torch.where(visible, along.mean(dim=2).norm(dim=-1), 0.0).amax(dim=1)
    spread = (corners - corners.mean(dim=1, keepdim=True))
    across = spread - (spread * sight[:, None]).sum(dim=-1, keepdim=True) * sight[:, None]
    footprint = across.square().sum(dim=-1).mean(dim=-1).sqrt() / window.radius
    good = (
        exists
        & (count >= _fewest(scope, options))
        & (slant > math.cos(math.radians(options.max_slant)))
        & (sigma * shift < options.max_sigma)
        & (distance > scope.near)
        & (distance < scope.far)
    ).nonzero()[:, 0]
    patches = Patches(
        reference=scope.ids[:1].expand(len(rows)),
        pixels=pixels,
        points=points,
        normals=normal,
        sigma=sigma,
        footprint=footprint,
        score=score.double(),
        others=scope.ids[comparison.image],
        visible=visible,
    )
    return patches[good], rows[good]
