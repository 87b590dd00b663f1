"""Speed of `torchrefrac triangulate` on one CPU core: a table of tracks in, a table of points out.

    python tools/bench/tracks.py [--points 100000] [--views 2]

An aquarium seen from above, its points to 60 cm deep, by cameras 40 cm above the water around it. Prints seconds of the
command without what the interpreter takes to start, on the clock and of the processor (the two differ on a busy
machine), and how far off points are: root mean square over the standard deviations that the command states, which is 1
where these are right.
"""

import csv
import math
import tempfile
import time
from pathlib import Path

import torch
from baseline import bench_parser, figure
from solver_problems import looking_at
from torch import Tensor

import torchrefrac as tr
from torchrefrac.commands.triangulate import POINTS, triangulate_run
from torchrefrac.config.clouds import TriangulateOptions
from torchrefrac.files.cameras import CAMERAS, write_cameras

PIXEL_SIGMA, REPEATS = 0.3, 3


def main() -> None:
    parser = bench_parser("Speed of the triangulation of tracks on one core.")
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--views", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        points = _write_run(folder, arguments.points, arguments.views)
        options = TriangulateOptions(str(folder), str(folder / "tracks.csv"), out=str(folder / "out"))
        times = []
        for _ in range(REPEATS):
            start, processor = time.perf_counter(), time.process_time()
            triangulate_run(options)
            times.append((time.perf_counter() - start, time.process_time() - processor))
        wall, processor = (min(taken) for taken in zip(*times, strict=True))
        found = _read_points(folder / "out" / POINTS)
    off = (found[:, 1:4] - points[found[:, 0].long()]) / found[:, 4:7]
    label = f"{arguments.points:,} points in {arguments.views} views"
    print(f"{label}: {wall:.2f} s, {processor:.2f} s of the processor, {len(found):,} points placed")
    print(f"errors over their standard deviations: {float(off.square().mean().sqrt()):.3f} (RMS)")
    figure(f"{label}: time of the processor", processor, "s", "lower", 0.2)
    figure(f"{label}: errors over standard deviations", float(off.square().mean().sqrt()), "x", "lower")


def _write_run(folder: Path, count: int, views: int) -> Tensor:
    """cameras.json and tracks.csv; returns the true points."""
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(((-20.0, -20.0, -60.0), (20.0, 20.0, -10.0)), dtype=torch.float64)
    points = low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    angle = torch.arange(views, dtype=torch.float64) * (2.0 * math.pi / views)
    center = torch.stack((15.0 * angle.cos(), 15.0 * angle.sin(), torch.full_like(angle, 40.0)), dim=-1)
    aim = center.new_tensor((0.0, 0.0, -30.0)).expand_as(center)
    pose = tr.Rigid(looking_at(center, aim, torch.zeros_like(angle)), center)
    lens = tr.Intrinsics.create(1280, 960, 900.0, distortion=(-0.05, 0.01, 0.0, 0.0, 0.0))
    scene = tr.Scene.create(pose, lens, tr.Interfaces.level(1.333), points[:0], tr.Observations.none())
    write_cameras(scene, folder / CAMERAS)
    pixels = scene.camera_of()[:, None].project(points)[0]
    pixels = pixels - 0.5 + PIXEL_SIGMA * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    with (folder / "tracks.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(("frame", "id", "view", "x", "y"))
        for i, places in enumerate(pixels.transpose(0, 1).tolist()):
            table.writerows((i, 0, name, *map("{:.4f}".format, at)) for name, at in
                            zip(scene.views.names, places, strict=True))  # fmt: skip
    return points


def _read_points(path: Path) -> Tensor:
    """Frame, position and standard deviations of each point."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = [[float(text) for text in row[:1] + row[2:8]] for row in list(csv.reader(file))[1:]]
    return torch.tensor(rows, dtype=torch.float64)


if __name__ == "__main__":
    main()
