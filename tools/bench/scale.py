"""What a reconstruction costs that grows: seconds, memory and accuracy of flights of 50 to 1000 photographs.

    python tools/bench/scale.py [--views 50,100,200,400] [--keypoints 1000] [--partners 30] [--seed 0]

A made river's bed under a drone that flies to and fro, its photographs overlapping by three quarters of their sides.
There are no photographs: keypoints are points of the bed as they are seen through water, found again in seven of ten
images, with NOISE px; pairs are those that overlap most by their positions, so many partners of each image, and of
their matches WRONG are wrong. Positions are known to 2 and 3 cm, gravity to half a degree. Each flight has a process
of its own, on one core. Printed are seconds of the processor for each stage, the largest memory, how many views are
registered, how far cameras are from the truth (root mean square, in the frame of the positions), and as which power of
the number of views the seconds of the whole grow. `--views 1000` takes twenty minutes.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from baseline import bench_parser, figure
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.features import Features, MatchOptions, PairMatches, build_tracks
from torchrefrac.features.pairs import best_partners, pairs_of
from torchrefrac.geometry import rotate, so3_exp
from torchrefrac.recorder import Advance, SilentRecorder
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Cameras, Capture, Interfaces, Scene
from torchrefrac.sfm import RefractiveInitializer, SfmOptions, reconstruct_sparse, verify_pairs
from torchrefrac.sfm.footprints import NO_OVERLAP, position_scores
from torchrefrac.synthetic.options import CameraOptions
from torchrefrac.synthetic.paths import grid, look_at, rolls
from torchrefrac.synthetic.scenes.ground import bed, cells

T = TypeVar("T")
CAMERA = CameraOptions(width=1200, height=900, fov_deg=65.0)
INDEX_RATIO, ALTITUDE, DEPTH, OVERLAP, SWAY_DEG = 1.333, 25.0, 3.0, 0.75, 2.0  # m
NODE = 0.25  # m, of the bed's heights
FOUND, NOISE, WRONG, GRAVITY_DEG, POSITION_SIGMA = 0.7, 0.4, 0.12, 0.5, (0.02, 0.02, 0.03)
BLUR = 0.04
"""Of a component of a descriptor, by which those of one point differ: a scalar product of 0.83."""
STAGES = ("verifying", "tracks", "registering", "adjusting", "assessing", "rest")


def main() -> None:
    parser = bench_parser("Cost of reconstructions of many photographs.")
    parser.add_argument("--views", default="50,100,200,400", help="how many, of each flight")
    parser.add_argument("--keypoints", type=int, default=1000, help="of an image")
    parser.add_argument("--partners", type=int, default=MatchOptions().per_image, help="of an image")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps(_work(options)))
        return
    heads = "".join(f"{name:>13}" for name in (*STAGES, "all"))
    print(f"{'views':>6}{'pairs':>7}{heads}{'GiB':>6}{'registered':>12}{'cameras, mm':>13}", flush=True)
    counts = [int(text) for text in options.views.split(",")]
    spent = [_report(options, count) for count in counts]
    if len(counts) > 1:
        exponent = float(np.polyfit(np.log(counts), np.log(spent), 1)[0])
        print(f"the whole grows as the {exponent:.2f}th power of the views")
        figure("exponent", exponent, "", "lower", 0.1)


def _report(options: argparse.Namespace, count: int) -> float:
    """Seconds of the processor for the whole."""
    asked = {"views": count, "keypoints": options.keypoints, "partners": options.partners, "seed": options.seed}
    command = [sys.executable, __file__, "--worker", *(f"--{name}={value}" for name, value in asked.items())]
    done = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])
    seconds = [done[name] for name in STAGES]
    columns = "".join(f"{value:>13.1f}" for value in (*seconds, sum(seconds)))
    print(
        f"{count:>6}{done['pairs']:>7}{columns}{done['peak']:>6.2f}{done['registered']:>12}{done['rms']:>13.2f}",
        flush=True,
    )
    figure(f"{count} views: time of the processor", sum(seconds), "s", "lower", 0.3)
    figure(f"{count} views: memory", done["peak"], "GiB", "lower", 0.2)
    figure(f"{count} views: registered", done["registered"], "views", "higher", 0.0)
    figure(f"{count} views: cameras", done["rms"], "mm", "lower", 0.1)
    return sum(seconds)


def _work(options: argparse.Namespace) -> dict[str, Any]:
    """One flight, in a process of its own."""
    torch.set_num_threads(1)
    flight, sfm, clock = Flight.make(options), SfmOptions(), Clock()
    capture, generator = flight.capture, torch.Generator().manual_seed(options.seed)
    initializer = RefractiveInitializer(capture, INDEX_RATIO, sfm)
    least = sfm.min_pair_inliers
    pairs = verify_pairs(flight.matches, flight.features, initializer, least, generator, clock)
    with clock.stage("tracks"):
        seen, colors = build_tracks(flight.features, [pair.pair for pair in pairs])
        scene = Scene.of_capture(capture, seen, colors, INDEX_RATIO)
    with clock.stage("sparse"):
        features = flight.features
        found = reconstruct_sparse(scene, capture, pairs, initializer, sfm, generator, clock, features=features)
    parts = sum(clock.seconds[name] for name in ("registering", "adjusting", "assessing"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {
        **clock.seconds,
        "rest": clock.seconds["sparse"] - parts,
        "pairs": len(flight.matches),
        "peak": peak,
        "registered": found.views.num_registered,
        "rms": 1e3 * flight.off(found),
    }


class Clock(SilentRecorder):
    """Seconds of the processor that stages take, by their descriptions."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times what is done within."""
        start = time.process_time()
        yield
        self.seconds[name] += time.process_time() - start  # type: ignore[assignment]

    def track(self, items: Iterable[T], total: int, description: str, unit: str) -> Iterator[T]:
        with self.stage(description):
            yield from items

    @contextmanager
    def _metered(self, description: str) -> Iterator[Advance]:
        with self.stage(description):
            yield lambda count, text: None

    def meter(self, total: int, description: str, unit: str) -> AbstractContextManager[Advance]:
        return self._metered(description)


@dataclass(frozen=True, eq=False)
class Flight:
    """What a reconstruction is given, and where the cameras (m) truly are."""

    capture: Capture
    features: list[Features]
    matches: list[PairMatches]
    center: Float[Tensor, "m 3"]

    @classmethod
    def make(cls, options: argparse.Namespace) -> "Flight":
        """With as many views as `options` say, keypoints and partners of each, and chance by their seed."""
        generator = torch.Generator().manual_seed(options.seed)
        rotation, center = _path(int(options.views))
        points = _ground(center, options)
        lens = Intrinsics.create(CAMERA.width, CAMERA.height, CAMERA.focal)
        capture = _capture(lens, rotation, center, generator)
        looks = normalize(torch.rand(len(points), 128, generator=generator), dim=-1)
        features, shown = [], []
        for view in range(len(center)):
            camera = RefractiveCamera(lens, rotation[view], center[view], FlatInterface(INDEX_RATIO))
            near = ((points - center[view])[:, :2].norm(dim=-1) < ALTITUDE).nonzero()[:, 0]
            pixels, inside = camera.project(points[near], inside_image=True)
            found = inside & (torch.rand(len(near), generator=generator) < FOUND)
            ids, pixels = near[found], pixels[found]
            pixels = pixels + NOISE * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
            alike = normalize(looks[ids] + BLUR * torch.randn(len(ids), 128, generator=generator), dim=-1)
            gray = torch.full((len(ids), 3), 128, dtype=torch.uint8)
            features.append(Features(pixels, alike, gray, torch.ones(len(ids)).double()))
            shown.append(ids.numpy())
        chosen = best_partners(position_scores(capture), options.partners, above=NO_OVERLAP)
        matches = [_matches(i, j, shown, generator) for i, j in pairs_of(chosen).tolist()]
        return cls(capture, features, matches, center)

    def off(self, scene: Scene) -> float:
        """Root mean square distance of registered cameras from the truth, in the frame of the positions."""
        registered = scene.views.registered
        raised = scene.views.center[registered] + torch.tensor((0.0, 0.0, scene.assessment.lowered_by or 0.0))
        return float((raised - self.center[registered]).square().sum(dim=-1).mean().sqrt())


def _path(views: int) -> tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 3"]]:
    """Rows to and fro about as long as they are many, straight down but for some sway."""
    columns = math.ceil(math.sqrt(1.6 * views))
    wide = ALTITUDE * CAMERA.width / CAMERA.focal
    step = (1.0 - OVERLAP) * wide
    center = grid(columns, math.ceil(views / columns), (step, step * CAMERA.height / CAMERA.width), ALTITUDE)[:views]
    sway = rolls(views, SWAY_DEG)
    below = center + ALTITUDE * torch.stack((sway.sin(), sway.roll(3).sin(), -torch.ones_like(sway)), dim=-1)
    return look_at(center, below, rolls(views, 3.0), up=(0.0, 1.0, 0.0)), center


def _ground(center: Float[Tensor, "m 3"], options: argparse.Namespace) -> Float[Tensor, "n 3"]:
    """Points of the bed and its bank, as many as an image of `keypoints` wants."""
    rng = np.random.default_rng(options.seed)
    wide = ALTITUDE * CAMERA.width / CAMERA.focal
    half = tuple((center[:, :2].amax(dim=0) + 0.75 * wide).tolist())
    height = torch.from_numpy(bed(cells(half, NODE), half, DEPTH, rng))
    per_image = wide * wide * CAMERA.height / CAMERA.width
    count = round(options.keypoints / FOUND / per_image * 4.0 * half[0] * half[1])
    at = torch.from_numpy(rng.uniform(-1.0, 1.0, (count, 2)))
    flipped = at * at.new_tensor((1.0, -1.0))  # the first row is the northernmost
    z = grid_sample(height[None, None], flipped[None, None], align_corners=False, padding_mode="border")[0, 0, 0]
    return torch.cat((at * at.new_tensor(half), z[:, None]), dim=1)


def _capture(
    lens: Intrinsics, rotation: Float[Tensor, "m 3 3"], center: Float[Tensor, "m 3"], generator: torch.Generator
) -> Capture:
    """What is known of the views."""
    count, sigma = len(center), center.new_tensor(POSITION_SIGMA)
    shaken = math.radians(GRAVITY_DEG) * torch.randn(center.shape, generator=generator, dtype=torch.float64)
    names = tuple(f"{view:04d}.jpg" for view in range(count))
    return Capture(
        folder=Path(),
        names=names,
        paths=tuple(map(Path, names)),
        cameras=Cameras.of([lens]),
        interfaces=Interfaces.level(INDEX_RATIO),
        down_in_cam=rotate(so3_exp(shaken), -rotation[..., 2]),
        down_sigma=torch.full((count,), math.radians(GRAVITY_DEG)).double(),
        height=torch.zeros(count).double(),
        has_height=torch.zeros(count, dtype=torch.bool),
        length_unit="m",
        position=center + sigma * torch.randn(center.shape, generator=generator, dtype=torch.float64),
        position_sigma=sigma.expand(count, 3),
    )


def _matches(first: int, second: int, shown: list[np.ndarray], generator: torch.Generator) -> PairMatches:
    """Of the points that both images show, and as many wrong ones as are expected among them."""
    _, mine, other = np.intersect1d(shown[first], shown[second], assume_unique=True, return_indices=True)
    matches = torch.from_numpy(np.stack((mine, other), axis=-1))
    wrong = torch.rand(len(matches), generator=generator) < WRONG
    anywhere = torch.randint(len(shown[second]), (len(matches),), generator=generator)
    return PairMatches(first, second, torch.where(wrong[:, None], torch.stack((matches[:, 0], anywhere), 1), matches))


if __name__ == "__main__":
    main()
