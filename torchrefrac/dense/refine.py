"""From a guess to a patch: which images to compare with, and the photometric adjustment."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.dense.judge import Subjects, fewest_others, judge
from torchrefrac.dense.neighbours import angle_between, fitness
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches, Planes
from torchrefrac.dense.photometric import Comparison, unit_windows
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.window import Window
from torchrefrac.optim.batched import minimize_each
from torchrefrac.parallel import side_by_side

TOLERANCE = 1e-3  # of the cost: an adjustment ends within a fifth of a standard deviation
SIDE_BY_SIDE, FEWEST = 4, 1024  # batches, and patches in one of these
MIN_SCALE = 0.4  # of an image against the reference: one that shows the surface smaller than this is not compared


def refine(
    scope: Scope, pixels: Float[Tensor, "n 2"], planes: Planes, options: DenseOptions
) -> tuple[Patches, Int[Tensor, " k"]]:
    """Adjust patches centred at reference pixels from `planes` (n), in batches. Returns those that are to be believed
    and which of the n they are. Guesses may be off by a pixel or two."""

    def adjusted(rows: slice) -> tuple[Patches, Int[Tensor, " b"]]:
        subjects, chosen = _choose(scope, pixels[rows], planes[rows], options)
        comparison, states = _adjust(scope, subjects, options)
        patches, good = judge(scope, subjects, comparison, states, options)
        return patches, chosen[good] + rows.start

    results = side_by_side(adjusted, _batches(len(pixels), options.batch), scope.device)
    nothing = Patches.empty(min(options.views, scope.others), scope.device)
    return (
        Patches.together([nothing, *(patches for patches, _ in results)]),
        torch.cat([nothing.reference, *(rows for _, rows in results)]),
    )


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


def _batches(count: int, most: int) -> list[slice]:
    """Of at most so many, and if that leaves fewer than `SIDE_BY_SIDE`, smaller ones; the same on every machine."""
    parts = max(-(-count // most), min(SIDE_BY_SIDE, count // FEWEST), 1)
    return [slice(part * count // parts, (part + 1) * count // parts) for part in range(parts)] if count else []


def _choose(
    scope: Scope, pixels: Float[Tensor, "n 2"], planes: Planes, options: DenseOptions
) -> tuple[Subjects, Int[Tensor, " k"]]:
    """Those of the n guesses that can be compared, with what is needed for it, and which of the n they are."""
    here = torch.zeros(len(pixels), dtype=torch.long, device=scope.device)
    reference, contrast = unit_windows(scope.atlas, here, here, pixels, Window(options.window))
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
    rows = rows[enough]
    subjects = (pixels[rows], rays[rows], planes[rows], reference[rows], contrast[rows])
    return Subjects(*subjects, image[enough], present[enough]), rows


def _adjust(scope: Scope, subjects: Subjects, options: DenseOptions) -> tuple[Comparison, Float[Tensor, "k 3"]]:
    """The comparison of the patches, and the states that it led to."""
    window = Window(options.window)
    corners = PixelRays.cast(scope.cameras[0], subjects.pixels[:, None] + window.corners.to(subjects.pixels))
    distances = corners.meet(subjects.planes.points[:, None], subjects.planes.normals[:, None])
    states = distances @ torch.linalg.inv(window.basis).T.to(distances)
    comparison = Comparison(
        atlas=scope.atlas,
        window=window,
        cameras=scope.cameras[subjects.image[..., None]],
        rays=corners,
        reference=subjects.reference,
        image=subjects.image,
        level=torch.zeros_like(subjects.image),
        present=subjects.present,
        tau=options.loss_scale,
    ).at_matching_levels(states, MIN_SCALE)
    if options.iterations:
        states = minimize_each(comparison, states, options.iterations, TOLERANCE).states
    return comparison, states
