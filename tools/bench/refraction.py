"""Speed and accuracy of the refraction core on one CPU core: the Snell solve, its derivatives, the projection.

    python tools/bench/refraction.py [--points 1000000] [--no-compile]

Prints millions of points a second, each beside the eigenvalues of the paper's quartic (by torch.linalg.eigvals, on
a part of the points), then the worst errors against roots in extended precision. The best of
several runs counts. Compiling takes about a minute.
"""

import math
import time
from collections.abc import Callable

import numpy as np
import torch
from baseline import bench_parser, figure
from torch import Tensor
from tqdm import tqdm

import torchrefrac as tr
from torchrefrac.refraction import apparent_height, apparent_height_partials

REPEATS = 9
COMPANION_POINTS = 50_000
INDEX_RATIO = 1.333


def main() -> None:
    parser = bench_parser("Speed and accuracy of refraction on one core.")
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--no-compile", action="store_true", help="leave out what torch.compile makes")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    jobs = _speed_jobs(arguments.points, not arguments.no_compile)
    rates = {}
    for name, (function, points) in tqdm(jobs.items(), desc="timing", unit="row", leave=False):
        rates[name] = points / _best_seconds(function) / 1e6
    print(
        f"One core, {arguments.points:,} points, torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}\n"
    )
    print(f"{'':<58}{'M points/s':>12}{'x companion':>14}")
    for name, rate in rates.items():
        peer = rates["companion eigenvalues, float32" if "float32" in name else "companion eigenvalues, float64"]
        print(f"{name:<58}{rate:>12.2f}{rate / peer:>13.0f}x")
        if rate != peer:
            figure(f"{name}, to companion", rate / peer, "x", "higher", 0.2)
    print(f"\n{'worst error':<58}{'float64':>12}{'float32':>14}")
    solve = [_worst_solve_error(dtype) for dtype in (np.float64, np.float32)]
    print(f"{'refrax ratio, relative (2 M cases, see the source)':<58}{solve[0]:>12.1e}{solve[1]:>14.1e}")
    figure("refrax ratio, worst relative error, float64", solve[0], "", "lower", 0.5)
    figure("refrax ratio, worst relative error, float32", solve[1], "", "lower", 0.5)
    trip = [_worst_round_trip(dtype) for dtype in (torch.float64, torch.float32)]
    print(f"{'project(cast_rays(u)) - u, pixels (1 M)':<58}{trip[0]:>12.1e}{trip[1]:>14.1e}")
    figure("project(cast_rays(u)) - u, worst, float64", trip[0], "px", "lower", 0.5)
    figure("project(cast_rays(u)) - u, worst, float32", trip[1], "px", "lower", 0.5)


def _speed_jobs(points: int, with_compile: bool) -> dict[str, tuple[Callable[[], object], int]]:
    jobs: dict[str, tuple[Callable[[], object], int]] = {}
    for dtype, name in ((torch.float64, "float64"), (torch.float32, "float32")):
        case = _scene(points, dtype)
        few = [value[:COMPANION_POINTS] if value.dim() else value for value in case]
        jobs[f"companion eigenvalues, {name}"] = (_bind(_by_companion, *few), COMPANION_POINTS)
        jobs[f"Newton, eager, {name}"] = (_bind(_by_newton, *case), points)
        jobs[f"Halley, eager, {name}"] = (_bind(tr.solve_refrax, *case), points)
        jobs[f"Halley with all implicit gradients, eager, {name}"] = (_bind(_solve_with_gradients, *case), points)
        if with_compile:
            for function, words in ((_solve, "Halley"), (_solve_with_gradients, "Halley with all implicit gradients")):
                compiled = torch.compile(function, fullgraph=True)
                jobs[f"{words}, torch.compile, {name}"] = (_bind(compiled, *case), points)
    camera, in_water = _camera(torch.float64), _points(points, torch.float64)
    rotations, centers = camera.cam_from_world_rotation.repeat(points, 1, 1), camera.center_in_world.repeat(points, 1)
    cameras = tr.RefractiveCamera(camera.intrinsics, rotations, centers, camera.interface)
    jobs["RefractiveCamera.project, eager, float64"] = (_bind(cameras.project, in_water), points)
    jobs["project_with_jacobians (all blocks), eager, float64"] = (
        _bind(cameras.project_with_jacobians, in_water),
        points,
    )
    pixels = cameras.project(in_water)[0]
    jobs["RefractiveCamera.cast_rays, eager, float64"] = (_bind(cameras.cast_rays, pixels), points)
    return jobs


def _solve(height: Tensor, depth: Tensor, distance: Tensor, index_ratio: Tensor) -> Tensor:
    return tr.solve_refrax(height, depth, distance, index_ratio)


def _by_newton(height: Tensor, depth: Tensor, distance: Tensor, index_ratio: Tensor) -> Tensor:
    return tr.solve_refrax(height, depth, distance, index_ratio, method="newton")


def _by_companion(height: Tensor, depth: Tensor, distance: Tensor, index_ratio: Tensor) -> Tensor:
    return tr.solve_refrax(height, depth, distance, index_ratio, method="companion")


def _solve_with_gradients(height: Tensor, depth: Tensor, distance: Tensor, index_ratio: Tensor) -> tuple[Tensor, ...]:
    """The refrax ratio h / H and its derivatives in height, depth, distance and index ratio."""
    distance_sq = distance * distance
    apparent = apparent_height(distance_sq, height, (depth,), (index_ratio,))
    partials = apparent_height_partials(apparent, distance_sq, height, (depth,), (index_ratio,))
    ratio = height / apparent
    by_apparent = -ratio / apparent
    return (
        ratio,
        1.0 / apparent + by_apparent * partials.by_clear,
        by_apparent * partials.by_thickness[0],
        by_apparent * partials.by_distance_sq * 2.0 * distance,
        by_apparent * partials.by_index[0],
    )


def _bind(function: Callable[..., object], *arguments: object) -> Callable[[], object]:
    return lambda: function(*arguments)


def _best_seconds(function: Callable[[], object]) -> float:
    best = math.inf
    with torch.no_grad():
        for _ in range(REPEATS):
            start = time.perf_counter()
            function()
            best = min(best, time.perf_counter() - start)
    return best


def _scene(count: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A drone over a river: 1 to 3 above, 0 to 5 deep, up to 10 away."""
    generator = torch.Generator().manual_seed(1)
    height, depth, distance = torch.rand((3, count), generator=generator, dtype=torch.float64)
    index_ratio = torch.tensor(INDEX_RATIO, dtype=dtype)
    return (1.0 + 2.0 * height).to(dtype), (5.0 * depth).to(dtype), (10.0 * distance).to(dtype), index_ratio


def _camera(dtype: torch.dtype) -> tr.RefractiveCamera:
    """Tilted by 30 degrees, with a lens."""
    s, c = 0.5, math.sqrt(0.75)
    rotation = torch.tensor([[1.0, 0.0, 0.0], [0.0, -c, -s], [0.0, s, -c]], dtype=dtype)
    lens = tr.Intrinsics.create(4000, 3000, 3000.0, distortion=(-0.1, 0.05, 1e-3, -5e-4, -0.01), dtype=dtype)
    return tr.RefractiveCamera(
        lens, rotation, torch.tensor([0.0, 0.0, 2.0], dtype=dtype), tr.FlatInterface(INDEX_RATIO)
    )


def _points(count: int, dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    unit = torch.rand((count, 3), generator=generator, dtype=dtype)
    return unit * unit.new_tensor((2.0, 2.0, 3.0)) + unit.new_tensor((-1.0, 0.5, -3.1))


def _worst_round_trip(dtype: torch.dtype) -> float:
    camera = _camera(dtype)
    generator = torch.Generator().manual_seed(3)
    unit = torch.rand((1_000_000, 3), generator=generator, dtype=dtype)
    pixels = unit[:, :2] * unit.new_tensor((camera.intrinsics.width, camera.intrinsics.height))
    origins, directions, valid = camera.cast_rays(pixels)
    seen, possible = camera.project(origins + (0.01 + 20.0 * unit[:, 2:]) * directions)
    assert bool((valid & possible).all())
    return float((seen - pixels).norm(dim=-1).max())


def _worst_solve_error(dtype: type[np.floating]) -> float:
    """Relative, for depth/height 1e-3 to 1e3, up to 89.9 degrees, index ratio 1 to 2.5, half of the cases crowded
    towards index ratio 1 and half towards nadir and grazing rays. The truth is Newton's in 80-bit floats, run for
    the very inputs that the solve gets."""
    rng = np.random.default_rng(4)
    count, limit = 2_000_000, np.deg2rad(89.9)
    height = 10.0 ** rng.uniform(-2.0, 2.0, count)
    depth = height * 10.0 ** rng.uniform(-3.0, 3.0, count)
    near_one = 1.0 + 10.0 ** rng.uniform(-8.0, math.log10(1.5), count)
    index = np.where(rng.random(count) < 0.5, near_one, rng.uniform(1.0, 2.5, count)).clip(1.0, 2.5)
    spread = 10.0 ** rng.uniform(-3.0, math.log10(np.tan(limit)), count)
    tangent = np.where(rng.random(count) < 0.5, spread, np.tan(rng.uniform(0.0, limit, count)))
    distance = height * tangent + depth * tangent / np.sqrt(index**2 + (index**2 - 1.0) * tangent**2)
    case = [value.astype(dtype) for value in (height, depth, distance, index)]
    ratio = _solve(*(torch.from_numpy(value) for value in case)).numpy()
    truth = _extended_refrax(*(value.astype(np.longdouble) for value in case))
    return float(np.abs((ratio - truth) / truth).max())


def _extended_refrax(height: np.ndarray, depth: np.ndarray, distance: np.ndarray, index: np.ndarray) -> np.ndarray:
    excess = (index - 1.0) * (index + 1.0) * distance**2
    grazing = (1.0 - depth / np.sqrt(np.maximum(excess, np.longdouble(1e-300)))) / height
    s = np.maximum(1.0 / (height + depth / index), grazing)
    for _ in range(25):
        w = 1.0 / np.sqrt(index**2 + excess * s**2)
        s = s - (s * (height + depth * w) - 1.0) / (height + depth * index**2 * w**3)
    return height * s


if __name__ == "__main__":
    main()
