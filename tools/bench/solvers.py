"""Success, accuracy and speed of the pose solvers and of RANSAC on one core, with PoseLib on the pinhole twin beside.

    python tools/bench/solvers.py [--problems 1000] [--workers 2] [--only minimal,layers,relative,...]

The problems are those of solver_problems.py. PoseLib (pip install poselib) runs where it is installed, with its default
options and the same error limit, on the same scene without water: that is the problem it can solve.
Each worker takes a part of the problems and one thread. Speeds are measured alone, medians over several problems.
"""

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any, Literal

import numpy as np
import torch
from baseline import bench_parser, figure
from solver_problems import GEOMETRIES, HEADING_LIMIT_DEG, POSITION_LIMIT, Geometry, Problem, make_problem
from torch import Tensor
from tqdm import tqdm

import torchrefrac as tr
from torchrefrac.geometry import level_rotation, so3_log
from torchrefrac.ransac import (
    AbsolutePoseEstimator,
    AbsolutePoseEstimators,
    Estimators,
    RansacOptions,
    RelativePoseEstimator,
    RelativePoseEstimators,
    level_rays,
    ransac,
    ransac_each,
)
from torchrefrac.refinement import tilt_and_heading
from torchrefrac.refraction.interface import GLASS
from torchrefrac.sfm.unknown_vertical import find_verticals

MATCHES = 2000
TOGETHER, REPEATS = 32, 3
OPTIONS = RansacOptions(max_error=2.0)
SPEED_PROBLEMS = 25
LAYERED = ("4-point", "7-point", "12-point", "2-point", "LSQI")
Known = Literal["T(m)", "T(0)", "none"]


def main() -> None:
    parser = bench_parser("Pose solvers and RANSAC: success, accuracy, speed.")
    parser.add_argument("--problems", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--only", default="minimal,layers,relative,absolute,vertical,speed", help="parts to run, by commas"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    parts = arguments.only.split(",")
    run = partial(_in_parallel, problems=arguments.problems, workers=arguments.workers)
    print(f"{arguments.problems} problems, torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}")
    if "minimal" in parts:
        _report_minimal(arguments.problems)
    if "layers" in parts:
        _report_layers(arguments.problems)
    if "relative" in parts:
        _report_relative(run)
    if "absolute" in parts:
        _report_absolute(run)
    if "vertical" in parts:
        _report_vertical(run)
    if "speed" in parts:
        _report_speed()


def _report_minimal(problems: int) -> None:
    """Noise-free success, and four points against seven in the same noisy samples."""
    print(f"\n{'minimal solvers':<44}{'4-point':>10}{'7-point':>10}{'2-point':>10}{'7 / 4':>8}")
    for geometry in GEOMETRIES:
        for noise in (0.0, 0.1, 0.3):
            found = torch.tensor([_solve_minimal(geometry, noise, seed) for seed in range(problems)])
            if noise == 0.0:
                four, seven, two = (found < 1e-6).double().mean(dim=0).tolist()
                print(f"{geometry + ', noise-free: true pose found':<44}{four:>10.2%}{seven:>10.2%}{two:>10.2%}")
                for points, share in ((4, four), (7, seven), (2, two)):
                    figure(f"{geometry}, noise-free, {points}-point: true pose found", share, "", "higher", 0.03)
            else:
                four, seven, two = found.median(dim=0).values.tolist()
                label = f"{geometry}, {noise} px: median position error"
                print(f"{label:<44}{four:>10.2%}{seven:>10.2%}{two:>10.3%}{seven / four:>8.2f}")
                figure(f"{label}, 4-point", four, "of baseline", "lower")


def _solve_minimal(geometry: str, noise: float, seed: int) -> tuple[float, float, float]:
    """Best valid candidate of each solver: error of the centre over the baseline (2-point: over the height); noise-free
    the larger of it and the error of the heading."""
    problem = make_problem(geometry, 7, torch.Generator().manual_seed(seed), noise=noise)  # type: ignore[arg-type]
    levels = level_rotation(problem.down_in_cam)
    rays1, rays2 = (level_rays(plane, level) for plane, level in zip(problem.plane, levels, strict=True))
    height, truth = float(problem.center[0, 2]), problem.true_model()
    four = tr.minimal.relative_pose_4pt(rays1[:4], rays2[:4], problem.index_ratio, height)
    # The n-point form of the 7-point solver keeps poses with a point above the water, where noise can put one.
    linear = tr.minimal.relative_pose_7pt if noise == 0.0 else tr.minimal.relative_pose_npt
    seven = linear(rays1, rays2, problem.index_ratio, height)
    two = tr.minimal.absolute_pose_2pt(rays2[:2], problem.points[:2], problem.index_ratio)
    first_heading = float(_heading(problem, 0))
    absolute_truth = torch.cat(((truth[4] + first_heading)[None], problem.center[1]))
    exact = noise == 0.0
    return (
        _best(four, truth[4:], problem.baseline, exact),
        _best(seven, truth[4:], problem.baseline, exact),
        _best(two, absolute_truth, float(problem.center[1, 2]), exact),
    )


def _report_layers(problems: int) -> None:
    """Poses through the glass of an aquarium, those of the same scene without it, and what it costs to leave it out:
    median error of the position, over the baseline or the height."""
    print(f"\n{'aquarium, 12 mm of glass':<44}" + "".join(f"{name:>10}" for name in LAYERED))
    exact = torch.tensor([_solve_layered(1.2, 0.0, "T(m)", seed) for seed in range(problems)])
    shares = (exact < 1e-8).double().mean(dim=0).tolist()
    print(f"{'noise-free: true pose found to 1e-8':<44}" + "".join(f"{share:>10.2%}" for share in shares))
    for name, share in zip(LAYERED, shares, strict=True):
        figure(f"aquarium, noise-free, {name}: true pose found", share, "", "higher", 0.003)
    for noise in (0.0, 0.3):
        medians = {}
        rows: tuple[tuple[str, float, Known], ...] = (
            ("no glass", 0.0, "none"),
            ("glass", 1.2, "T(m)"),
            ("glass, T(0) in place of T(m)", 1.2, "T(0)"),
            ("glass, not modelled", 1.2, "none"),
            ("glass of 5 cm", 5.0, "T(m)"),
            ("glass of 5 cm, T(0) in place of T(m)", 5.0, "T(0)"),
            ("glass of 5 cm, not modelled", 5.0, "none"),
        )
        for label, glass, known in rows:
            found = torch.tensor([_solve_layered(glass, noise, known, seed) for seed in range(problems)])
            medians[label] = found.median(dim=0).values
            print(f"{f'{noise} px, {label}':<44}" + "".join(f"{error:>10.3%}" for error in medians[label].tolist()))
        if noise:
            ratio = medians["glass"] / medians["no glass"]
            print(f"{'ratio of glass to no glass':<44}" + "".join(f"{value:>10.3f}" for value in ratio.tolist()))
            for name, value in zip(LAYERED, ratio.tolist(), strict=True):
                figure(f"aquarium, {noise} px, {name}: error through glass to that without", value, "x", "lower")


def _solve_layered(glass: float, noise: float, known: Known, seed: int) -> tuple[float, ...]:
    """Best valid candidate of each solver, as in `_solve_minimal`, for glass that is known, known at normal incidence,
    or not known."""
    problem = make_problem("aquarium", 12, torch.Generator().manual_seed(seed), noise=noise, glass=glass)
    levels = level_rotation(problem.down_in_cam)
    rays1, rays2 = (level_rays(plane, level) for plane, level in zip(problem.plane, levels, strict=True))
    height, truth, exact = float(problem.center[0, 2]), problem.true_model(), noise == 0.0
    layers = problem.layers if known == "T(m)" else None
    # T(0) is the same for all rays: it raises both cameras.
    lift = glass * (1.0 / GLASS - 1.0 / problem.index_ratio) if known == "T(0)" else 0.0
    seven = tr.minimal.relative_pose_7pt if exact else tr.minimal.relative_pose_npt
    relative = (
        tr.minimal.relative_pose_4pt(rays1[:4], rays2[:4], problem.index_ratio, height + lift, layers=layers),
        seven(rays1[:7], rays2[:7], problem.index_ratio, height + lift, layers=layers),
        tr.minimal.relative_pose_npt(rays1, rays2, problem.index_ratio, height + lift, layers=layers),
    )
    heading, center, valid = tr.minimal.absolute_pose_lsqi(rays2, problem.points, problem.index_ratio, layers=layers)
    absolute = (
        tr.minimal.absolute_pose_2pt(rays2[:2], problem.points[:2], problem.index_ratio, layers=layers),
        (heading[None], center[None], valid[None]),
    )
    absolute_truth = torch.cat(((truth[4] + float(_heading(problem, 0)))[None], problem.center[1]))
    lifted = truth.new_tensor((0.0, 0.0, 0.0, lift))
    return (
        *(_best(found, truth[4:] + lifted, problem.baseline, exact) for found in relative),
        *(_best(found, absolute_truth + lifted, float(problem.center[1, 2]), exact) for found in absolute),
    )


def _heading(problem: Problem, image: int) -> Tensor:
    level_from_world = level_rotation(problem.down_in_cam[image]).mT @ problem.rotation[image]
    return torch.atan2(level_from_world[1, 0], level_from_world[0, 0])


def _best(found: tuple[Tensor, Tensor, Tensor], truth: Tensor, scale: float, exact: bool) -> float:
    heading, center, valid = found
    error = (center - truth[1:]).norm(dim=-1) / scale
    if exact:
        turned = heading - truth[0]
        error = torch.maximum(error, torch.atan2(turned.sin(), turned.cos()).abs())
    return float(torch.where(valid, error, torch.inf).min())


def _report_relative(run: Callable[..., Any]) -> None:
    title = f"relative pose RANSAC, {MATCHES} matches, 0.5 px"
    print(f"\n{title:<44}{'right':>8}{'position':>10}{'heading':>10}{'/ CRB':>8}{'ms':>8}{'samples':>9}")
    for geometry in GEOMETRIES:
        for outliers in (0.5, 0.8):
            for gravity_deg in (0.5, 2.0):
                rows = run(partial(_relative, geometry, outliers, gravity_deg), geometry)
                position, heading, expected, seconds, samples = rows.T
                right = (position < POSITION_LIMIT[geometry]) & (heading < HEADING_LIMIT_DEG)
                ratio = (position[right].square().mean() / expected[right].square().mean()).sqrt()
                label = f"{geometry}, {outliers:.0%} outliers, gravity {gravity_deg:g} deg off"
                print(
                    f"{label:<44}{right.double().mean():>8.1%}{position.median():>10.3%}{heading.median():>9.4f}°"
                    f"{ratio:>8.3f}{1e3 * seconds.median():>8.0f}{samples.median():>9.0f}",
                    flush=True,
                )
                figure(f"relative pose, {label}: right", float(right.double().mean()), "", "higher", 0.03)
                figure(f"relative pose, {label}: over the bound", float(ratio), "x", "lower")


def _relative(geometry: str, outliers: float, gravity_deg: float, seed: int) -> tuple[float, ...]:
    """Errors, the expected error by the Cramér-Rao bound, seconds, samples."""
    generator = torch.Generator().manual_seed(seed)
    problem = make_problem(geometry, MATCHES, generator, outliers=outliers, gravity_error_deg=gravity_deg)  # type: ignore[arg-type]
    start = time.process_time()
    report = ransac(RelativePoseEstimator(problem.two_views()), OPTIONS, generator)
    seconds = time.process_time() - start
    errors = problem.relative_errors(report.model) if report.status == "success" else (math.inf, 180.0)
    return *errors, _cramer_rao(problem), seconds, report.num_samples


def _cramer_rao(problem: Problem) -> float:
    """Root of the trace of the bound on the position, over the baseline: from all true matches and gravity."""
    views = problem.two_views().rows(problem.right)
    hessian = views.linearize(problem.true_model()[None], math.inf).hessian[0]
    covariance = torch.linalg.inv(hessian) * views.pixel_sigma**2
    return float(covariance.diagonal()[5:].sum().sqrt()) / problem.baseline


def _report_absolute(run: Callable[..., Any]) -> None:
    title = f"absolute pose RANSAC, {MATCHES} points, 0.5 px"
    print(f"\n{title:<44}{'right':>8}{'position':>10}{'rotation':>10}{'':>8}{'ms':>8}{'samples':>9}")
    for geometry in GEOMETRIES:
        for outliers, gravity_deg in ((0.5, 0.5), (0.8, 2.0)):
            position, rotation, seconds, samples = run(partial(_absolute, geometry, outliers, gravity_deg), geometry).T
            right = (position < 0.005) & (rotation < 0.1)
            label = f"{geometry}, {outliers:.0%} outliers, gravity {gravity_deg:g} deg off"
            print(
                f"{label:<44}{right.double().mean():>8.1%}{position.median():>10.3%}{rotation.median():>9.4f}°"
                f"{'':>8}{1e3 * seconds.median():>8.0f}{samples.median():>9.0f}",
                flush=True,
            )
            figure(f"absolute pose, {label}: right", float(right.double().mean()), "", "higher", 0.03)
            figure(f"absolute pose, {label}: position", float(position.median()), "of height", "lower")


def _absolute(geometry: str, outliers: float, gravity_deg: float, seed: int) -> tuple[float, ...]:
    """Position over the height, rotation in degrees, seconds, samples."""
    generator = torch.Generator().manual_seed(seed)
    problem = make_problem(geometry, MATCHES, generator, outliers=outliers, gravity_error_deg=gravity_deg)  # type: ignore[arg-type]
    view = problem.one_view()
    start = time.process_time()
    report = ransac(AbsolutePoseEstimator(view), OPTIONS, generator)
    seconds = time.process_time() - start
    if report.status != "success":
        return math.inf, 180.0, seconds, report.num_samples
    rotation, center = (part[0] for part in view.poses(report.model[None]))
    angle = math.degrees(float(so3_log(rotation @ problem.rotation[1].mT).norm()))
    position = float((center - problem.center[1]).norm() / problem.center[1, 2])
    return position, angle, seconds, report.num_samples


def _report_vertical(run: Callable[..., Any]) -> None:
    """Pairs whose verticals nobody measured: how far off the estimated ones are, and how honest their sigma is."""
    title = f"unknown verticals, {MATCHES} matches, 0.5 px"
    print(f"\n{title:<44}{'< 1 deg':>8}{'median':>10}{'95 %':>10}{'/ sigma':>8}{'ms':>8}")
    for geometry in GEOMETRIES:
        for outliers in (0.5, 0.7):
            angle, ratio, seconds = run(partial(_vertical, geometry, outliers), geometry).T
            print(
                f"{f'{geometry}, {outliers:.0%} outliers':<44}{(angle < 1.0).double().mean():>8.1%}"
                f"{angle.median():>9.3f}°{angle.quantile(0.95):>9.3f}°"
                f"{ratio[ratio.isfinite()].square().mean().sqrt():>8.2f}{1e3 * seconds.median():>8.0f}",
                flush=True,
            )
            found = float((angle < 1.0).double().mean())
            figure(f"unknown verticals, {geometry}, {outliers:.0%} outliers: within 1 deg", found, "", "higher", 0.03)


def _vertical(geometry: str, outliers: float, seed: int) -> tuple[float, float, float]:
    """Larger error of the two verticals in degrees, the same over its sigma, seconds."""
    problem = make_problem(geometry, MATCHES, torch.Generator().manual_seed(seed), outliers=outliers)  # type: ignore[arg-type]
    views = problem.two_views()
    start = time.process_time()
    found = find_verticals(views.plane1, views.plane2, views.focal, views.index_ratio, OPTIONS.max_error)
    seconds = time.process_time() - start
    if found.status != "success":
        return 180.0, math.inf, seconds
    off = torch.linalg.cross(found.down_in_cam, problem.down_in_cam).norm(dim=-1).clamp(max=1.0).asin()
    return math.degrees(float(off.max())), float((off / found.sigma).square().mean().sqrt()), seconds


def _report_speed() -> None:
    """Time of the processor beside PoseLib, in turn on each problem, and scoring rates.

    PoseLib draws at least 1000 samples by default; "at will" it stops as soon as its confidence allows.
    """
    print(f"\n{'speed, 50 % outliers, gravity 0.5 deg off':<44}{'ours':>10}{'PoseLib':>10}{'ratio':>8}{'at will':>10}")
    for geometry in GEOMETRIES:
        for name, ours in (("relative pose", _relative), ("absolute pose", _absolute)):
            theirs = partial(_poselib, geometry, name.startswith("relative"))
            times = [
                (ours(geometry, 0.5, 0.5, seed)[-2], theirs(seed, {}), theirs(seed, {"min_iterations": 32}))
                for seed in range(SPEED_PROBLEMS)
            ]
            mine, peer, at_will = 1e3 * np.median(np.array(times[2:]), axis=0)
            print(f"{f'{geometry}, {name}':<44}{mine:>7.1f} ms{peer:>7.1f} ms{mine / peer:>8.2f}{at_will:>7.1f} ms")
            figure(f"{geometry}, {name}: time to PoseLib's", mine / peer, "x", "lower", 0.2)
        for name, ours in (("relative pose", _pairs_together), ("absolute pose", _views_together)):
            theirs = partial(_poselib, geometry, name.startswith("relative"))
            mine = 1e3 * ours(geometry)
            peer, at_will = (
                1e3 * sum(theirs(seed, options) for seed in range(TOGETHER)) / TOGETHER
                for options in ({}, {"min_iterations": 32})
            )
            label = f"{name}, {TOGETHER} at a time"
            print(f"{f'{geometry}, {label}':<44}{mine:>7.1f} ms{peer:>7.1f} ms{mine / peer:>8.2f}{at_will:>7.1f} ms")
            figure(f"{geometry}, {label}: time to PoseLib's", mine / peer, "x", "lower", 0.2)
    _report_scoring()


def _pairs_together(geometry: Geometry) -> float:
    """Seconds a pair, of some that are solved at once."""
    pairs = [problem.two_views() for problem in _some_problems(geometry)]
    return _seconds_of_each(lambda: RelativePoseEstimators(pairs))


def _views_together(geometry: Geometry) -> float:
    """Seconds a view, of some that are solved at once."""
    views = [problem.one_view() for problem in _some_problems(geometry)]
    return _seconds_of_each(lambda: AbsolutePoseEstimators(views))


def _some_problems(geometry: Geometry) -> list[Problem]:
    generators = [torch.Generator().manual_seed(seed) for seed in range(TOGETHER)]
    return [make_problem(geometry, MATCHES, one, outliers=0.5, gravity_error_deg=0.5) for one in generators]


def _seconds_of_each(estimators: Callable[[], Estimators]) -> float:
    """Of TOGETHER problems, made ready and solved at once; the median of several times."""
    seconds: list[float] = []
    for _ in range(REPEATS):
        generators = [torch.Generator().manual_seed(seed) for seed in range(TOGETHER)]
        start = time.process_time()
        ransac_each(estimators(), OPTIONS, generators)
        seconds.append(time.process_time() - start)
    return float(np.median(seconds)) / TOGETHER


def _poselib(geometry: str, relative: bool, seed: int, options: dict[str, Any]) -> float:
    """Seconds on the same scene without water."""
    try:
        import poselib  # noqa: PLC0415 - a peer that need not be there
    except ImportError:
        return math.nan
    twin = make_problem(geometry, MATCHES, torch.Generator().manual_seed(seed), outliers=0.5, index_ratio=1.0)  # type: ignore[arg-type]
    camera = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [twin.focal, 0.0, 0.0]}
    one, two = twin.pixels.numpy()
    points = twin.points.numpy()
    start = time.process_time()
    if relative:
        options = {**options, "max_epipolar_error": OPTIONS.max_error}
        poselib.estimate_relative_pose(one, two, camera, camera, options, {})
    else:
        poselib.estimate_absolute_pose(two, points, camera, {**options, "max_reproj_error": OPTIONS.max_error}, {})
    return time.process_time() - start


def _report_scoring() -> None:
    """Hypotheses a second over all matches, as the loop screens them: in single precision, tilts zero."""
    print(f"\n{f'exact refractive scoring, {MATCHES} data':<44}{'eager':>10}{'compiled':>10}  hypotheses/s")
    problem = make_problem("tank", MATCHES, torch.Generator().manual_seed(0))
    relative, absolute = RelativePoseEstimator(problem.two_views()), AbsolutePoseEstimator(problem.one_view())
    view = problem.one_view()
    for name, estimator, model in (
        ("absolute pose (reprojection error)", absolute, _absolute_truth(problem, view.cam_from_level)),
        ("relative pose (epipolar error)", relative, problem.true_model()),
    ):
        wiggle = 1e-3 * torch.randn((512, len(model)), generator=torch.Generator().manual_seed(1))
        models = model.float() + wiggle
        models[:, : len(model) - 4] = 0.0

        def score(models: Tensor, estimator: AbsolutePoseEstimator | RelativePoseEstimator = estimator) -> Tensor:
            return estimator.squared_errors(models, None).clamp(max=4.0).sum(dim=-1)

        rates = [_rate(score, models, 16), _rate(torch.compile(score), models, 512)]
        print(f"{name:<44}" + "".join(f"{rate:>10,.0f}" for rate in rates))


def _absolute_truth(problem: Problem, cam_from_level: Tensor) -> Tensor:
    tilt, heading = tilt_and_heading(cam_from_level, problem.rotation[1])
    return torch.cat((tilt, heading[None], problem.center[1]))


def _rate(score: Callable[[Tensor], Tensor], models: Tensor, batch: int) -> float:
    best = math.inf
    with torch.no_grad():
        for _ in range(8):
            start = time.perf_counter()
            for part in models.split(batch):
                score(part)
            best = min(best, time.perf_counter() - start)
    return len(models) / best


def _in_parallel(solve: Callable[[int], Sequence[float]], label: str, problems: int, workers: int) -> Tensor:
    """solve(seed) for every problem, by several processes of one thread each."""
    seeds = range(problems)
    if workers < 2:
        return torch.tensor([solve(seed) for seed in tqdm(seeds, desc=label, unit="problem", leave=False)])
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_one_thread) as pool:
        results = pool.map(solve, seeds, chunksize=5)
        return torch.tensor(list(tqdm(results, total=problems, desc=label, unit="problem", leave=False)))


def _one_thread() -> None:
    torch.set_num_threads(1)


if __name__ == "__main__":
    main()
