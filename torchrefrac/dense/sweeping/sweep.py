"""Where the surface of a whole image begins: every pixel is compared at many distances, as in a plane sweep.

The pixels of a small copy of the reference are put at one distance after the other along their own bent rays (Collins,
CVPR 1996, sweeps a plane; points at one distance need not lie in one), looked up in the other images and compared in
small windows. Through the distances that agree best a plane is laid around each pixel, which gives the normal, too.
"""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.judge import fewest_others
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.rays import PixelRays
from torchrefrac.dense.refine import Planes
from torchrefrac.dense.scope import Scope
from torchrefrac.dense.sweeping.lattice import Copies, Lattice
from torchrefrac.dense.sweeping.surface import LOWEST, Peaks, best_half, box, fit_planes

IMAGES = 6  # others that are looked into at most
PROBES = 9  # rays each way that decide how far the distances are to be apart
STEP = 1.0  # pixels of the copies that something moves from one distance to the next
MOST = 0.75  # of what is seen moves by less than that
FEWEST = 6  # distances of the narrowest range: best between them, not at its ends
AHEAD = 32  # distances projected at once


def sweep(scope: Scope, options: DenseOptions) -> tuple[Float[Tensor, "k 2"], Planes, Float[Tensor, " k"]]:
    """Guesses for the cells of the tile, good enough for `refine`.

    Returns the centres of the cells that have one, in the order of `Scope.centers`, their planes, each through a point
    on the centre's ray, and their scores, a mean ZNCC. A cell has none where the images do not
    agree to `sweep.min_score`, where they agree best at `near` or `far` itself, and where it has no neighbours of like
    distance.
    """
    lattice = Lattice.of(scope, options)
    others = scope.cameras[1 : 1 + min(scope.others, max(IMAGES, fewest_others(scope, options)))]
    distances = _distances(scope, others, lattice, options)
    if len(distances) < 3 or min(lattice.width, lattice.height) <= 2 * lattice.radius:
        nothing = torch.zeros(0, 3, dtype=torch.float64, device=scope.device)
        return nothing[:, :2], Planes(nothing, nothing), nothing[:, 0]
    step, score = _best_steps(scope, others, lattice, distances, options)
    step[score < options.sweep.min_score] = math.nan
    return _guesses(scope, lattice, distances, *fit_planes(step, score), options)


def _distances(scope: Scope, others: RefractiveCamera, lattice: Lattice, options: DenseOptions) -> Float[Tensor, " n"]:
    """Distances between which things move by `STEP` in the other images; by more where that would be too many, by
    less where too few."""
    columns, rows = (torch.linspace(0.0, n - 1.0, PROBES, dtype=torch.float64) for n in (lattice.width, lattice.height))
    rays = PixelRays.cast(scope.cameras[0], lattice.pixels(columns, rows).view(-1, 2))
    fine = torch.linspace(scope.near, scope.far, 2 * options.sweep.planes, dtype=torch.float64, device=scope.device)
    points = rays.at(fine[:, None])
    pixels, seen = others[:, None, None].project(points, inside_image=True)
    seen = seen & _ahead(scope.cameras[0], rays, points)
    move = torch.where(seen[:, 1:] & seen[:, :-1], (pixels[:, 1:] - pixels[:, :-1]).norm(dim=-1), math.nan)
    move = move.transpose(0, 1).flatten(1).nanquantile(MOST, dim=1).nan_to_num(0.0) / 2**lattice.level
    path = torch.cat((move.new_zeros(1), move.cumsum(dim=0)))
    length = float(path[-1])
    least = FEWEST if length > 0.0 else 1
    count = min(options.sweep.planes, max(math.ceil(length / STEP) + 1, least))
    return _interpolate(torch.linspace(0.0, length, count, dtype=torch.float64, device=scope.device), path, fine)


def _best_steps(
    scope: Scope, others: RefractiveCamera, lattice: Lattice, distances: Float[Tensor, " n"], options: DenseOptions
) -> tuple[Float[Tensor, "r c"], Float[Tensor, "r c"]]:
    """Which distance is best for each lattice pixel, as a fraction between two, and its score."""
    radius, size, fewest = lattice.radius, 2 * lattice.radius + 1, fewest_others(scope, options)
    f = lattice.grey_of(scope)
    mean_f = box(f, size)
    var_f = (box(f * f, size) - mean_f.square()).clamp(min=0.0)
    floor = (options.noise / 2**lattice.level) ** 2
    height, width = mean_f.shape
    copies, peaks = Copies.of(scope, others.shape[0], lattice), Peaks(mean_f)
    for at in _places(scope, others, lattice, distances):
        g, allowed = copies.sample(at.to(f))
        mean_g, square_g, fg = box(torch.stack((g, g * g, f * g)), size)
        var_g = (square_g - mean_g * mean_g).clamp_(min=0.0)
        zncc = (fg - mean_f * mean_g) * ((var_f + floor) * (var_g + floor)).rsqrt_()
        usable = copies.fits_window(at[:, radius : radius + height, radius : radius + width])
        if allowed is not None:
            usable = usable & (box(allowed, size) > 0.999)
        peaks.add(best_half(torch.where(usable, zncc, LOWEST), usable.sum(dim=0), fewest, options.views))
    step, score = peaks.finish()
    score[var_f.sqrt() < options.min_contrast / 2**lattice.level] = LOWEST
    return torch.nn.functional.pad(step, (radius,) * 4), torch.nn.functional.pad(score, (radius,) * 4, value=LOWEST)


def _places(
    scope: Scope, others: RefractiveCamera, lattice: Lattice, distances: Float[Tensor, " n"]
) -> Iterator[Float[Tensor, "m r c 2"]]:
    """For each distance, image pixels where the lattice is seen; far outside where it is not."""
    columns, rows, spread = lattice.nodes()
    rays = PixelRays.cast(scope.cameras[0], lattice.pixels(columns, rows))
    for some in distances.split(AHEAD):
        points = rays.at(some[:, None, None])
        pixels, seen = others[:, None, None, None].project(points)
        seen = seen & _ahead(scope.cameras[0], rays, points)
        pixels = torch.where(seen[..., None], pixels.clamp(-1e6, 1e6), -1e6).to(scope.atlas.sheet)
        for one in pixels.unbind(dim=1):
            yield spread(one)


def _guesses(
    scope: Scope,
    lattice: Lattice,
    distances: Float[Tensor, " n"],
    plane: Float[Tensor, "3 r c"],
    score: Float[Tensor, "r c"],
    options: DenseOptions,
) -> tuple[Float[Tensor, "k 2"], Planes, Float[Tensor, " k"]]:
    """What `sweep` returns: each cell lies in the plane of the lattice pixel that it is nearest to."""
    pixels = scope.centers(options.cell).view(-1, 2)
    at = lattice.locate(pixels)
    nearest = at.round().clamp(min=0.0).minimum(at.new_tensor((lattice.width - 1, lattice.height - 1)))
    column, row = nearest.long().unbind(dim=-1)
    plane, score = plane.double(), score[row, column].double()
    step = plane[0, row, column] + (plane[1:, row, column].T * (at - nearest)).sum(dim=-1)
    allowed = scope.is_allowed(torch.zeros(len(pixels), dtype=torch.long, device=scope.device), pixels)
    good = ((score > LOWEST) & (step >= 0.0) & (step <= len(distances) - 1) & allowed).nonzero()[:, 0]
    pixels, step, column, row = pixels[good], step[good], column[good], row[good]
    points = PixelRays.cast(scope.cameras[0], pixels).at(_distance_of(step, distances))
    return pixels, Planes(points, _normals(scope, lattice, distances, plane)[row, column]), score[good]


def _normals(
    scope: Scope, lattice: Lattice, distances: Float[Tensor, " n"], plane: Float[Tensor, "3 r c"]
) -> Float[Tensor, "r c 3"]:
    """Unit normals in the world frame, from where the rays of each lattice pixel's corners end."""
    columns, rows = (torch.arange(n + 1, dtype=torch.float64) - 0.5 for n in (lattice.width, lattice.height))
    rays = PixelRays.cast(scope.cameras[0], lattice.pixels(columns, rows))

    def end(right: int, below: int) -> Float[Tensor, "r c 3"]:
        step = plane[0] + (right - 0.5) * plane[1] + (below - 0.5) * plane[2]
        corner = (slice(below, below + lattice.height), slice(right, right + lattice.width))
        return rays[corner].at(_distance_of(step, distances))

    normals = torch.linalg.cross(end(1, 1) - end(0, 0), end(0, 1) - end(1, 0), dim=-1)
    return torch.nn.functional.normalize(normals, dim=-1)


def _distance_of(step: Float[Tensor, "*batch"], distances: Float[Tensor, " n"]) -> Float[Tensor, "*batch"]:
    return _interpolate(step, torch.arange(len(distances), dtype=step.dtype, device=step.device), distances)


def _interpolate(
    at: Float[Tensor, "*batch"], x: Float[Tensor, " n"], y: Float[Tensor, " n"]
) -> Float[Tensor, "*batch"]:
    """y(at), linear between x, which does not fall, and beyond its ends."""
    i = torch.searchsorted(x, at.contiguous(), right=True).clamp(1, len(x) - 1)
    width = (x[i] - x[i - 1]).clamp(min=1e-12)
    return y[i - 1] + (y[i] - y[i - 1]) * ((at - x[i - 1]) / width)


def _ahead(camera: RefractiveCamera, rays: PixelRays, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
    """Whether points of the rays lie in front of their camera, not behind it."""
    return ((points - camera.center_in_world) * rays.before).sum(dim=-1) > 0.0
