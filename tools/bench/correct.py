"""Speed of the correction of clouds on one CPU core, beside loops over points and cameras in plain Python.

    python tools/bench/correct.py [--points 65000] [--cameras 40]

A drone 40 m above a bed under up to 3 m of water, every camera of which sees a part. Prints seconds and points a second
of both methods, each beside a scalar loop that does the same on a part of the points and nothing else, and the largest
difference of the two. The loop of "mean" is the correction of Dietrich (2017); ours finds standard deviations and
misfits, too. The best of several runs counts.
"""

import math
import time
from collections.abc import Callable
from typing import TypeVar

import torch
from baseline import bench_parser, figure
from torch import Tensor

from torchrefrac.correction import CorrectionRules, correct_points
from torchrefrac.correction.rules import Method
from torchrefrac.scene import Viewpoints

T = TypeVar("T")
Point = tuple[float, float, float]
REPEATS, INDEX_RATIO, MAX_ANGLE_DEG = 3, 1.333, 60.0
LOOP_POINTS = 2000
SIDE, HEIGHT, DEPTH = 80.0, 40.0, 3.0  # m
HALF_FIELD = (0.7, 0.5)  # x/z and y/z at the edges of an image


def main() -> None:
    parser = bench_parser("Speed of the correction of clouds on one core.")
    parser.add_argument("--points", type=int, default=65_000)
    parser.add_argument("--cameras", type=int, default=40)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    points, cameras = _survey(arguments.points, arguments.cameras)
    level, wet = torch.zeros_like(points[:, 2]), torch.ones(len(points), dtype=torch.bool)
    print(f"One core, {len(points):,} points, {len(cameras)} cameras, torch {torch.__version__}\n")
    print(f"{'':<8}{'s':>8}{'points/s':>12}{'loop, points/s':>16}{'x loop':>8}{'worst (mm)':>12}{'cameras/point':>17}")
    loops: dict[Method, Callable[[Point, list[Point]], float]] = {"rays": _meeting, "mean": _mean}
    for method, of_rays in loops.items():
        rules = CorrectionRules(method=method, index_ratio=INDEX_RATIO, max_angle_deg=MAX_ANGLE_DEG)
        seconds, found = _timed(lambda rules=rules: correct_points(points, level, wet, cameras, rules))
        part = points[:LOOP_POINTS].tolist()
        loop_seconds, heights = _timed(lambda part=part, of_rays=of_rays: _loop(part, cameras, of_rays))
        rate, loop_rate = len(points) / seconds, len(part) / loop_seconds
        worst = 1000.0 * float((found.points[: len(part), 2] - torch.tensor(heights, dtype=torch.float64)).abs().max())
        views = float(found.views.double().mean())
        row = f"{seconds:>8.2f}{rate:>12,.0f}{loop_rate:>16,.0f}{rate / loop_rate:>7.1f}x{worst:>12.0e}{views:>17.1f}"
        print(f"{method:<8}{row}")
        figure(f"{method}, to a loop in Python", rate / loop_rate, "x", "higher", 0.3)
        figure(f"{method}, worst difference to the loop", worst, "mm", "lower", 1e3)


def _survey(points: int, cameras: int) -> tuple[Tensor, Viewpoints]:
    """Apparent points and cameras that look straight down, on a grid."""
    generator = torch.Generator().manual_seed(0)
    xy = SIDE * torch.rand(points, 2, generator=generator, dtype=torch.float64)
    z = -DEPTH * (0.1 + 0.9 * torch.rand(points, 1, generator=generator, dtype=torch.float64)) / INDEX_RATIO
    columns = math.ceil(math.sqrt(cameras))
    rows = math.ceil(cameras / columns)
    row, column = torch.arange(cameras) // columns, torch.arange(cameras) % columns
    place = torch.stack(((column + 0.5) / columns, (row + 0.5) / rows), dim=-1).double() * SIDE
    center = torch.cat((place, torch.full((cameras, 1), HEIGHT, dtype=torch.float64)), dim=-1)
    down = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)).expand(cameras, 3, 3)
    (x, y) = HALF_FIELD
    field = torch.tensor((-x, x, -y, y), dtype=torch.float64).expand(cameras, 4)
    return torch.cat((xy, z), dim=-1), Viewpoints(tuple(map(str, range(cameras))), center, down, field)


def _loop(
    points: list[list[float]], cameras: Viewpoints, height_of: Callable[[Point, list[Point]], float]
) -> list[float]:
    """The height of every point, from the cameras that see it."""
    centers, steepest = cameras.center.tolist(), math.tan(math.radians(MAX_ANGLE_DEG))
    half_x, half_y = HALF_FIELD
    heights = []
    for x, y, z in points:
        seen = []
        for cx, cy, cz in centers:
            down = cz - z
            if abs(x - cx) > half_x * down or abs(y - cy) > half_y * down:
                continue
            if math.hypot(x - cx, y - cy) <= steepest * down:
                seen.append((cx, cy, cz))
        heights.append(height_of((x, y, z), seen) if len(seen) > 1 else z)
    return heights


def _mean(point: Point, seen: list[Point]) -> float:
    """The mean of what single cameras give."""
    x, y, z = point
    total = 0.0
    for cx, cy, cz in seen:
        r = math.atan(math.hypot(x - cx, y - cy) / (cz - z))
        total += z * math.tan(r) / math.tan(math.asin(math.sin(r) / INDEX_RATIO))
    return total / len(seen)


def _meeting(point: Point, seen: list[Point]) -> float:
    """Where the bent rays meet: the normal equations of least squares, by Cramer's rule."""
    x, y, z = point
    a = b = c = d = e = f = p = q = r = 0.0
    for cx, cy, cz in seen:
        dx, dy, dz = x - cx, y - cy, z - cz
        way_sq = dx * dx + dy * dy + dz * dz
        way, share = math.sqrt(way_sq), -cz / dz
        ox, oy = cx + share * dx, cy + share * dy
        tx, ty = dx / way / INDEX_RATIO, dy / way / INDEX_RATIO
        tz = -math.sqrt(1.0 - tx * tx - ty * ty)
        weight, along = 1.0 / way_sq, ox * tx + oy * ty
        a, b, c = a + weight * (1.0 - tx * tx), b - weight * tx * ty, c - weight * tx * tz
        d, e, f = d + weight * (1.0 - ty * ty), e - weight * ty * tz, f + weight * (1.0 - tz * tz)
        p, q, r = p + weight * (ox - along * tx), q + weight * (oy - along * ty), r - weight * along * tz
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return (a * (d * r - e * q) - b * (b * r - c * q) + p * (b * e - c * d)) / determinant


def _timed(function: Callable[[], T]) -> tuple[float, T]:
    """Seconds of the fastest run, and what the last gave."""
    best, results = math.inf, []
    for _ in range(REPEATS):
        start = time.perf_counter()
        results = [function()]
        best = min(best, time.perf_counter() - start)
    return best, results[0]


if __name__ == "__main__":
    main()
