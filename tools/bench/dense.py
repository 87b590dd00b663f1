"""The dense stage: whole runs against truth, points and patches a second, and what the windows are sampled with.

    python tools/bench/dense.py [FOLDER] [--only runs|stage|patches|sampling] [--methods patch] [--models refractive]

Without a folder it takes the embedded scene. Whole runs are started as a user starts them, each in a process of its
own; the models without refraction are the peers, and the last column is their RMS to the true planes over the
refractive one of the same method. The stage alone is measured in points per second of all processors' time, from the
photographs to the cloud. Patches a second counts patches that are adjusted in up to five other images from
guesses a few pixels off, believed or not; PMVS2 makes 890 a second and core. Sampling compares PyTorch's grid_sample
with kornia's warps and its remap on the windows of patches.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import kornia.geometry.transform as warps
import torch
from baseline import bench_parser, figure
from torch import Tensor
from whole_runs import MODELS, measured_run

import torchrefrac as tr
from torchrefrac.dense.growth import Cells, grow
from torchrefrac.dense.images import Images
from torchrefrac.dense.neighbours import find_neighbours
from torchrefrac.dense.options import DenseOptions, Method
from torchrefrac.dense.patches import Patches, Planes
from torchrefrac.dense.refine import refine
from torchrefrac.dense.scope import scopes
from torchrefrac.dense.seeds import sparse_seeds
from torchrefrac.dense.window import Window
from torchrefrac.files.library import embedded_scene

METHODS: tuple[Method, ...] = ("patch", "depthmap")
OFF_PIXELS, OFF_NORMAL = 1.5, 0.2  # by which the guesses of the speed test miss, standard deviations
PATCHES = 16384
HEADER = (
    f"{'method':<9} {'model':<11} {'points':>7} {'accurate':>8} {'complete':>8} {'plane RMS':>12} "
    f"{'dense s':>7} {'wall s':>6} {'GiB':>5} {'ratio':>6}"
)


def main() -> None:
    parser = bench_parser("Dense reconstruction: truth, time and memory.")
    parser.add_argument("capture", nargs="?", type=Path, help="folder with capture.json and truth.json")
    parser.add_argument("--only", choices=("runs", "stage", "patches", "sampling"))
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--models", nargs="+", default=MODELS, choices=MODELS)
    options = parser.parse_args()
    folder = options.capture or embedded_scene("tank_small")
    if options.only in (None, "sampling"):
        sampling()
    if options.only in (None, "patches"):
        patches(folder)
    if options.only in (None, "stage"):
        stage(folder, options.methods)
    if options.only in (None, "runs"):
        runs(folder, options.methods, options.models)


def sampling(count: int = 2000) -> None:
    """Windows of 7 x 7 from one 1024 x 768 image, each with its own affinity."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 1, 768, 1024, generator=generator)
    window = Window(7)
    middle = torch.rand(count, 1, 2, generator=generator) * torch.tensor((960.0, 700.0)) + 32.0
    turn = torch.eye(2) + 0.1 * torch.randn(count, 2, 2, generator=generator)
    places = middle + window.offsets.float() @ turn.mT
    grid = (places / torch.tensor((1024.0, 768.0)) * 2.0 - 1.0)[None]
    wanted = grid.clone().requires_grad_()
    affinity = _window_from_image(turn, middle[:, 0])
    images = image.expand(count, -1, -1, -1)

    def with_slopes() -> Tensor:
        values = torch.nn.functional.grid_sample(image, wanted, align_corners=False)
        return torch.autograd.grad(values, wanted, torch.ones_like(values))[0]

    x, y = (places[..., axis][None] for axis in range(2))

    def remapped() -> Tensor:
        return warps.remap(image, x - 0.5, y - 0.5, align_corners=True)

    ways: dict[str, Callable[[], Tensor]] = {
        "grid_sample": lambda: torch.nn.functional.grid_sample(image, grid, align_corners=False),
        "grid_sample with slopes": with_slopes,
        "kornia.remap": remapped,
        "kornia.warp_affine": lambda: warps.warp_affine(images, affinity[:, :2], (7, 7)),
        "kornia.warp_perspective": lambda: warps.warp_perspective(images, affinity, (7, 7)),
    }
    reference = ways["grid_sample"]().view(count, 49)
    assert torch.allclose(remapped().view(count, 49), reference, atol=1e-3)
    assert torch.allclose(ways["kornia.warp_affine"]().view(count, 49), reference, atol=1e-3)
    print(f"sampling {count} windows of 7 x 7, bilinear, {torch.get_num_threads()} threads")
    rates = {name: count * 49 / _seconds(way) / 1e6 for name, way in ways.items()}
    for name, rate in rates.items():
        print(f"  {name:<24} {rate:6.1f} M samples/s  {rate / rates['grid_sample']:5.2f}x")
    figure("grid_sample, to kornia.warp_affine", rates["grid_sample"] / rates["kornia.warp_affine"], "x", "higher", 0.2)


def stage(folder: Path, methods: Sequence[Method]) -> None:
    """The dense stage of a sparse reconstruction, in one process."""
    scene = tr.reconstruct(tr.load_capture(folder))
    for method in methods:
        start = time.process_time()
        points = len(tr.densify(scene, DenseOptions(method=method)).cloud)
        seconds = time.process_time() - start
        print(f"{method:<9} {points} points in {seconds:.1f} s of processors, {points / seconds:.0f} points/s")
        figure(f"{folder.name}, {method}: points per CPU second", points / seconds, "points/s", "higher", 0.2)


def patches(folder: Path) -> None:
    """Adjust patches of one image from perturbed planes."""
    capture = tr.load_capture(folder)
    options = DenseOptions(method="patch")
    neighbourhoods = find_neighbours(tr.reconstruct(capture), options)
    view, neighbourhood = max(neighbourhoods.items(), key=lambda item: len(item[1].points))
    scope = next(scopes(neighbourhood, Images(capture), options))
    cells = Cells(scope, options.cell)
    start = time.perf_counter()
    grown = Patches.together(list(grow(scope, cells, options, sparse_seeds(scope, cells, options))))
    seconds = time.perf_counter() - start
    tried = int(cells.tries.sum())
    print(f"growth over {capture.names[view]}: {len(grown)} patches of {tried} tried in {seconds:.1f} s, "
          f"{len(grown) / seconds:.0f} patches/s")  # fmt: skip
    generator = torch.Generator().manual_seed(0)
    chosen = grown[torch.randperm(len(grown), generator=generator)[:PATCHES].sort().values]
    noise = torch.randn(len(chosen), 1, generator=generator, dtype=torch.float64)
    away = chosen.points - scope.cameras[0].center_in_world
    moved = chosen.points + OFF_PIXELS * chosen.footprint[:, None] * noise * torch.nn.functional.normalize(away, dim=-1)
    tilt = OFF_NORMAL * torch.randn(len(chosen), 3, generator=generator, dtype=torch.float64)
    for views in (3, 5, 8):
        chosen_options = DenseOptions(method="patch", views=views)

        def work(chosen_options: DenseOptions = chosen_options) -> Tensor:
            return refine(scope, chosen.pixels, Planes(moved, chosen.normals + tilt), chosen_options)[1]

        believed = len(work())
        rate = len(chosen) / _seconds(work, 3)
        print(
            f"  adjusting in up to {views} other images: {rate:6.0f} patches/s, {believed / len(chosen):.1%} believed"
        )
        figure(f"adjusting in up to {views} other images", rate, "patches/s", "higher", 0.2)


def runs(folder: Path, methods: Sequence[Method], models: list[str]) -> None:
    """Whole runs, sparse and dense."""
    print(HEADER)
    for method in methods:
        results = {
            model: measured_run("scene=capture", f"scene.path={folder}", f"model={model}", f"dense={method}")
            for model in models
        }
        best = results.get("refractive", {})
        for model, m in results.items():
            rms, unit = _figure(m, "dense_plane_rms_")
            reference, _ = _figure(best, "dense_plane_rms_")
            print(
                f"{method:<9} {model:<11} {m['dense_points']:>7} {_figure(m, 'dense_accuracy_within_0.2_')[0]:>8.2%} "
                f"{_figure(m, 'dense_completeness_within_0.5_')[0]:>8.2%} {rms:>9.4f} {unit:<2} "
                f"{m['seconds_dense']:>7.1f} {m['wall']:>6.1f} {m['peak']:>5.2f} {rms / reference:>5.0f}x"
            )
            if model == "refractive":
                label = f"{folder.name}, {method}"
                figure(f"{label}: accurate", _figure(m, "dense_accuracy_within_0.2_")[0], "", "higher")
                figure(f"{label}: complete", _figure(m, "dense_completeness_within_0.5_")[0], "", "higher")
                figure(f"{label}: plane RMS", rms, unit, "lower")
                figure(f"{label}: dense stage", m["seconds_dense"], "s", "lower", 0.2)
                figure(f"{label}: memory", m["peak"], "GiB", "lower")


def _figure(metrics: dict[str, Any], prefix: str) -> tuple[float, str]:
    """A metric and its unit; not a number where the capture has no truth for it."""
    key = next((key for key in metrics if key.startswith(prefix) and not key.startswith(f"{prefix}each")), None)
    return (math.nan, "") if key is None else (metrics[key], key.removeprefix(prefix))


def _window_from_image(turn: Tensor, middle: Tensor) -> Tensor:
    """Affinities (count, 3, 3) as kornia takes them, on indices of pixels: window index from image index."""
    image_from_window = torch.eye(3).repeat(len(turn), 1, 1)
    image_from_window[:, :2, :2] = turn
    image_from_window[:, :2, 2] = middle - 0.5 - 3.0 * turn.sum(dim=-1)
    return torch.linalg.inv(image_from_window)


def _seconds(work: Callable[[], Any], repeats: int = 10) -> float:
    work()
    start = time.perf_counter()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - start) / repeats


if __name__ == "__main__":
    main()
