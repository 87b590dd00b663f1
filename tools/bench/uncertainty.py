"""Is the adjustment as accurate as the noise allows, and does it know how accurate it is?

    python tools/bench/uncertainty.py [--draws 200] [--seed 0]

Draws images of a river bed from the air, with noise, many times, and adjusts each from a rough start: ten cameras with
measured gravity and positions, index ratio and water plane free; and the same without positions, where the gauge is
free. Prints for cameras, points, index ratio and plane the RMS error over the Cramer-Rao bound (the covariance at the
true state; errors and bound both free of the gauge), and how often the truth lies in the reported 95 % region.
"""

import math
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from baseline import bench_parser, figure
from jaxtyping import Float
from scipy.stats import chi2
from torch import Tensor

from torchrefrac.bundle import (
    BundleOptions,
    CenterPrior,
    Expectations,
    GravityPrior,
    Term,
    Uncertainty,
    adjust,
    uncertainty,
)
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid, so3_exp, so3_log
from torchrefrac.optim import LevenbergMarquardtOptions
from torchrefrac.scene import Interfaces, Observations, Scene

CAMERAS, POINTS, SEEN_BY = 10, 150, 5
PIXEL_SIGMA, GRAVITY_SIGMA, CENTER_SIGMA, HEIGHT_SIGMA = 0.4, math.radians(0.5), 0.02, 0.05
REFINED = ("index_ratio", "plane_tilt", "plane_height")
F64 = torch.float64


def main() -> None:
    parser = bench_parser("Errors over the Cramer-Rao bound, coverage of reported regions.")
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    truth = river(torch.Generator().manual_seed(arguments.seed))
    print(f"{CAMERAS} cameras, {POINTS} points, {len(truth.observations)} observations, {arguments.draws} draws")
    print(f"{'':<34} {'RMS / bound':>12} {'in 95 % region':>15}")
    for label, positions in (("with positions: ", True), ("gauge free: ", False)):
        start = time.perf_counter()
        for name, ratio, coverage in study(truth, positions, arguments.draws, arguments.seed):
            print(f"{label + name:<34} {ratio:>12.3f} {100.0 * coverage:>13.1f} %")
            figure(f"{label + name}, RMS over the bound", ratio, "x", "lower")
            figure(f"{label + name}, truth in the 95 % region", coverage, "", "higher", 0.03)
        print(f"{'':<34} {time.perf_counter() - start:.0f} s")


def river(generator: torch.Generator) -> Scene:
    """Cameras in two strips 3 m above a river, tilted up to 12 degrees; a bed 0.3 to 2 m deep. Metres."""

    def uniform(*shape: int) -> Float[Tensor, "..."]:
        return torch.rand(*shape, generator=generator, dtype=F64)

    grid = torch.cartesian_prod(torch.arange(CAMERAS // 2), torch.arange(2)).to(F64)
    center = torch.cat((1.2 * grid + 0.2 * uniform(CAMERAS, 2), 3.0 + 0.4 * uniform(CAMERAS, 1)), dim=-1)
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=F64))
    rotation = so3_exp(0.4 * (uniform(CAMERAS, 3) - 0.5)) @ down
    low, high = grid.amin(dim=0) * 1.2 - 0.8, grid.amax(dim=0) * 1.2 + 0.8
    points = torch.cat((low + (high - low) * uniform(POINTS, 2), -0.3 - 1.7 * uniform(POINTS, 1)), dim=-1)
    apart = (points[:, None, :2] - center[None, :, :2]).norm(dim=-1)
    view = apart.argsort(dim=1)[:, :SEEN_BY].flatten()
    point = torch.arange(POINTS).repeat_interleave(SEEN_BY)
    seen = Observations(view, point, torch.zeros(len(view), 2, dtype=F64))
    intrinsics = Intrinsics.create(2000, 1500, 1500.0)
    truth = Scene.create(Rigid(rotation, center), intrinsics, Interfaces.level(1.333), points, seen)
    pixels, valid = truth.camera_of(view).project(points[point])
    assert bool(valid.all())
    return replace(truth, observations=replace(seen, pixels=pixels))


def study(truth: Scene, positions: bool, draws: int, seed: int) -> list[tuple[str, float, float]]:
    """Rows of the table: name, RMS error over the bound, coverage."""
    generator = torch.Generator().manual_seed(seed + 1)

    def noise(*shape: int) -> Float[Tensor, "..."]:
        return torch.randn(*shape, generator=generator, dtype=F64)

    refine = REFINED if positions else ("index_ratio",)
    options = BundleOptions(
        loss="squared",
        pixel_sigma=PIXEL_SIGMA,
        refine=refine,
        expected=Expectations(plane_height=HEIGHT_SIGMA) if positions else Expectations(),
        solver=LevenbergMarquardtOptions(max_iterations=100, function_tolerance=1e-13),
    )
    ratios: dict[str, list[Tensor]] = {}
    inside: dict[str, list[Tensor]] = {}
    bound: Uncertainty | None = None
    for _ in range(draws):
        level, views, seen = HEIGHT_SIGMA * float(noise(1)) if positions else 0.0, truth.views, truth.observations
        rotation = so3_exp(0.01 * noise(CAMERAS, 3)) @ views.rotation
        start = replace(
            truth,
            views=views.at(rotation, views.center + 0.02 * noise(CAMERAS, 3)),
            points=truth.points + 0.02 * noise(POINTS, 3),
            interfaces=Interfaces.level(truth.index_ratio - 0.03, level),
            observations=replace(seen, pixels=seen.pixels + PIXEL_SIGMA * noise(len(seen), 2)),
        )
        terms = _measured(truth, positions, noise)
        report = adjust(start, options, terms=terms)
        known = uncertainty(report.problem, report.scene)
        bound = bound or uncertainty(report.problem, truth, PIXEL_SIGMA)
        for name, error, reported, least in _compared(report.scene, truth, known, bound, positions):
            size = least.diagonal(dim1=-2, dim2=-1)
            ratios.setdefault(name, []).append((error.square() / size).mean())
            solved = torch.linalg.solve(reported, error[..., None])[..., 0]
            limit = float(chi2.ppf(0.95, error.shape[-1]))
            inside.setdefault(name, []).append(((error * solved).sum(dim=-1) <= limit).double().mean())
    return [(n, float(torch.stack(r).mean().sqrt()), float(torch.stack(inside[n]).mean())) for n, r in ratios.items()]


def _measured(truth: Scene, positions: bool, noise: Callable[..., Float[Tensor, "..."]]) -> list[Term]:
    tilt = so3_exp(GRAVITY_SIGMA * noise(CAMERAS, 3))
    terms: list[Term] = [GravityPrior(-(tilt @ truth.views.rotation)[:, :, 2], GRAVITY_SIGMA)]
    if positions:
        information = torch.eye(3, dtype=F64).expand(CAMERAS, 3, 3) / CENTER_SIGMA**2
        position = truth.views.center + CENTER_SIGMA * noise(CAMERAS, 3)
        terms.append(CenterPrior(torch.arange(CAMERAS), position, information))
    return terms


def _compared(
    found: Scene, truth: Scene, known: Uncertainty, bound: Uncertainty, positions: bool
) -> list[tuple[str, Float[Tensor, "k d"], Float[Tensor, "k d d"], Float[Tensor, "k d d"]]]:
    """Name, errors, reported covariances and bounds."""
    turn = so3_log(found.views.rotation @ truth.views.rotation.mT)
    pose = torch.cat((turn, found.views.center - truth.views.center), dim=-1)
    points = found.points - truth.points
    if not positions:
        pose, points = _without_gauge(pose, points, truth)
    index = (found.interfaces.index_ratio - truth.interfaces.index_ratio)[:, None]
    rows = [
        ("rotations", pose[:, :3], known.pose[:, :3, :3], bound.pose[:, :3, :3]),
        ("centres", pose[:, 3:], known.pose[:, 3:, 3:], bound.pose[:, 3:, 3:]),
        ("points", points, known.points, bound.points),
        ("index ratio", index, known.index_ratio.square().view(1, 1, 1), bound.index_ratio.square().view(1, 1, 1)),
    ]
    if positions:
        normal, offset = found.interfaces.normal, found.interfaces.offset
        plane = torch.cat((torch.stack((-normal[:, 1], normal[:, 0]), dim=-1), offset[:, None]), dim=-1)
        first = 6 * CAMERAS + 1
        reported, least = (u.covariance[None, first:, first:] for u in (known, bound))
        rows.append(("plane", plane, reported, least))
    return rows


def _without_gauge(
    pose: Float[Tensor, "m 6"], points: Float[Tensor, "n 3"], truth: Scene
) -> tuple[Float[Tensor, "m 6"], Float[Tensor, "n 3"]]:
    """Errors less those motions of the whole scene that make the cameras' as small as can be."""
    zero, one = torch.zeros_like(truth.views.center), torch.eye(3, dtype=F64)
    cross = torch.linalg.cross
    motions, moved = [], []
    for axis in one[:2]:
        motions.append(torch.cat((zero, axis.expand_as(zero)), dim=-1))
        moved.append(axis.expand_as(points))
    up = one[2]
    motions.append(torch.cat((-(truth.views.rotation @ up), cross(up.expand_as(zero), truth.views.center)), dim=-1))
    moved.append(cross(up.expand_as(points), truth.points))
    motions.append(torch.cat((zero, truth.views.center), dim=-1))
    moved.append(truth.points)
    basis = torch.stack([motion.flatten() for motion in motions], dim=-1)
    amount = torch.linalg.lstsq(basis, pose.flatten()[:, None]).solution[:, 0]
    return (
        pose - torch.stack(motions, dim=-1) @ amount,
        points - torch.stack(moved, dim=-1) @ amount,
    )


if __name__ == "__main__":
    main()
