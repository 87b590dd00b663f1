"""From a guess to a patch: which images to compare with, and the photometric adjustment of many together."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.dense.attempts import MIN_SCALE, Attempts, Ended
from torchrefrac.dense.judge import Subjects, fewest_others
from torchrefrac.dense.neighbours import angle_between, fitness
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches, Planes
from torchrefrac.dense.photometric import correlations, unit_windows
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.window import Window
from torchrefrac.parallel import side_by_side

SIDE_BY_SIDE, FEWEST = 4, 1024  # batches, and patches in one of these


def refine(
    scope: Scope, pixels: Float[Tensor, "n 2"], planes: Planes, options: DenseOptions
) -> tuple[Patches, Int[Tensor, " k"]]:
    """Adjust patches centred at reference pixels from `planes` (n), in batches. Returns those that are to be believed
    and which of the n they are. Guesses may be off by a pixel or two."""

    def adjusted(rows: slice) -> list[Ended]:
        number = torch.arange(rows.start, rows.stop, device=scope.device)
        attempts, parts = attempt(scope, number, pixels[rows], planes[rows], options), []
        while len(attempts):
            attempts, ended = attempts.advance(scope, options)
            parts.append(ended)
        return parts

    ended = [one for some in side_by_side(adjusted, _batches(len(pixels), options), scope.device) for one in some]
    nothing = Patches.empty(min(options.views, scope.others), scope.device)
    patches = Patches.together([nothing, *(one.patches for one in ended)])
    good = torch.cat([nothing.reference, *(one.good for one in ended)])
    order = good.argsort()
    return patches[order], good[order]


def advance(scope: Scope, attempts: Attempts, options: DenseOptions) -> tuple[Attempts, Ended]:
    """One more pass for all of them, in batches: those that go on, and those that have ended."""
    parts = [attempts[rows] for rows in _batches(len(attempts), options)]
    going, ended = zip(*side_by_side(lambda part: part.advance(scope, options), parts, scope.device), strict=True)
    number, patches, good = zip(*ended, strict=True)
    return Attempts.together(going), Ended(torch.cat(number), Patches.together(list(patches)), torch.cat(good))


def attempt(
    scope: Scope, number: Int[Tensor, " n"], pixels: Float[Tensor, "n 2"], planes: Planes, options: DenseOptions
) -> Attempts:
    """Begin with those of n guesses, numbered, that can be compared: within reach, with texture, and with images that
    see them."""
    window = Window.across(options.window)
    here = torch.zeros_like(number)
    reference, contrast = unit_windows(scope.atlas, here, here, pixels, window)
    rays = PixelRays.cast(scope.cameras[0], pixels)
    distance = rays.meet(planes.points, planes.normals)
    rows = (
        (contrast >= options.min_contrast)
        & (distance > scope.near)
        & (distance < scope.far)
        & scope.is_allowed(here, pixels)
    ).nonzero()[:, 0]
    image, present = choose_views(scope, rays[rows].at(distance[rows]), options)
    enough = (present.sum(dim=1) >= fewest_others(scope, options)).nonzero()[:, 0]
    rows, image, present = rows[enough], image[enough], present[enough]
    corners, states = _at_corners(scope, pixels[rows], planes[rows], window)
    subjects = Subjects(pixels[rows], rays[rows], contrast[rows])
    return Attempts.begun(number[rows], subjects, corners, reference[rows], image, present, states)


def _at_corners(
    scope: Scope, pixels: Float[Tensor, "n 2"], planes: Planes, window: Window
) -> tuple[PixelRays, Float[Tensor, "n 3"]]:
    """The rays of the corners of windows at reference pixels, and the states of planes there."""
    corners = PixelRays.cast(scope.cameras[0], pixels[:, None] + window.corners.to(pixels))
    distances = corners.meet(planes.points[:, None], planes.normals[:, None])
    return corners, distances @ torch.linalg.inv(window.basis).T.to(distances)


def compare(
    scope: Scope, pixels: Float[Tensor, "n 2"], planes: Planes, image: Int[Tensor, " n"], options: DenseOptions
) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """How well planes (n) at reference pixels look the same in one other image each, as they are, and which do so well
    enough to be believed of surfaces that are known."""
    window = Window.across(options.window)

    def compared(rows: slice) -> tuple[Float[Tensor, " b"], Bool[Tensor, " b"]]:
        here, (points, normals) = torch.zeros_like(image[rows]), planes[rows]
        f, contrast = unit_windows(scope.atlas, here, here, pixels[rows], window)
        corners, states = _at_corners(scope, pixels[rows], planes[rows], window)
        zncc, usable, scale = correlations(
            scope.cameras, scope.atlas, corners, f, states, image[rows, None], window, matching_levels=True
        )
        middle = states[:, 0]
        to_camera = torch.nn.functional.normalize(scope.cameras[0].center_in_world - points, dim=-1)
        good = (
            (usable & (zncc >= options.min_score) & (scale >= MIN_SCALE))[:, 0]
            & (contrast >= options.min_contrast)
            & ((normals * to_camera).sum(dim=-1) > math.cos(math.radians(options.max_slant)))
            & (middle > scope.near)
            & (middle < scope.far)
            & scope.is_allowed(here, pixels[rows])
            & scope.is_allowed(image[rows], scope.cameras[image[rows]].project(points)[0])
        )
        return zncc[:, 0].to(states), good

    parts = side_by_side(compared, _batches(len(pixels), options), scope.device)
    nothing = pixels[:0, 0]
    score, good = zip((nothing, nothing > 0.0), *parts, strict=True)
    return torch.cat(score), torch.cat(good)


def choose_views(
    scope: Scope, points: Float[Tensor, "n 3"], options: DenseOptions
) -> tuple[Int[Tensor, "n v"], Bool[Tensor, "n v"]]:
    """For points, the local images to compare with, best first, and which of these will do. One that sees the point
    within its image, at an angle near the best."""
    cameras = scope.cameras
    local = torch.arange(1, 1 + scope.others, device=scope.device)
    pixels, seen = cameras[1:, None].project(points)
    seen = seen & scope.is_allowed(local[:, None].expand(seen.shape), pixels)
    angle = angle_between(cameras.center_in_world[1:, None], cameras.center_in_world[0], points)
    fits = torch.where(seen, fitness(angle, options), 0.0)
    best = fits.T.topk(min(options.views, scope.others), dim=1)
    return local[best.indices], best.values > 0.0


def _batches(count: int, options: DenseOptions) -> list[slice]:
    """Of at most so many, and if that leaves fewer than `SIDE_BY_SIDE`, smaller ones; the same on every machine."""
    parts = max(-(-count // options.batch), min(SIDE_BY_SIDE, count // FEWEST), 1)
    return [slice(part * count // parts, (part + 1) * count // parts) for part in range(parts)] if count else []
