"""Verification of pairs of images: seconds of one core for a pair that overlaps and for one that does not, and recall.

    python tools/bench/verification.py [--pairs 40] [--recall 500]

True pairs have 300 and 3000 matches, a fifth of them wrong; wrong ones 60, 150 and 300, all at random. Recall is over
pairs of 40 to 80 matches of which 15 to 50 % are wrong: the share of those with the 20 right ones that a pair needs in
which as many are found. Both geometries of `solver_problems`, gravity half a degree off.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from baseline import bench_parser, figure
from solver_problems import GEOMETRIES, Problem, make_problem

from torchrefrac.camera import Intrinsics
from torchrefrac.features import Features, PairMatches
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Cameras, Capture, Interfaces
from torchrefrac.sfm import RefractiveInitializer, SfmOptions, VerifiedPair, verify_pairs

LEAST = SfmOptions().min_pair_inliers
GRAVITY_DEG = 0.5


def main() -> None:
    parser = bench_parser("Verification of pairs.")
    parser.add_argument("--pairs", type=int, default=40, help="pairs of each geometry that are timed")
    parser.add_argument("--recall", type=int, default=500, help="pairs of each geometry that should be found")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'pairs':<40}{'ms, median':>12}{'ms, mean':>12}{'verified':>10}")
    for matches, wrong in ((300, 0.2), (3000, 0.2), (60, 1.0), (150, 1.0), (300, 1.0)):
        _report_time(matches, wrong, arguments)
    found = [_recall(arguments, geometry) for geometry in GEOMETRIES]
    share = sum(there for there, _ in found) / sum(count for _, count in found)
    print(f"recall of {sum(count for _, count in found)} pairs, 15 to 50 % of 40 to 80 matches wrong: {share:.2%}")
    figure("recall", share, "", "higher", 0.002)


def _report_time(matches: int, wrong: float, arguments: argparse.Namespace) -> None:
    """Seconds of the processor, not of the clock: other processes hardly change them."""
    label = f"{'true' if wrong < 1.0 else 'wrong'}, {matches} matches"
    seconds, verified = [], 0
    for geometry in GEOMETRIES:
        for seed in range(arguments.pairs):
            generator = torch.Generator().manual_seed(seed)
            problem = make_problem(geometry, matches, generator, outliers=wrong, gravity_error_deg=GRAVITY_DEG)
            start = time.process_time()
            verified += len(_verified(problem, generator))
            seconds.append(time.process_time() - start)
    times = 1e3 * torch.tensor(seconds)
    print(f"{label:<40}{times.median():>12.1f}{times.mean():>12.1f}{verified / len(seconds):>10.1%}", flush=True)
    figure(f"{label}: processor time", float(times.mean()), "ms", "lower", 0.3)


def _recall(arguments: argparse.Namespace, geometry: str) -> tuple[int, int]:
    """Pairs that were found, of how many."""
    found = there = 0
    for seed in range(arguments.recall):
        generator = torch.Generator().manual_seed(10_000 + seed)
        matches = int(torch.randint(40, 81, (), generator=generator))
        wrong = 0.15 + 0.35 * float(torch.rand((), generator=generator))
        problem = make_problem(geometry, matches, generator, outliers=wrong, gravity_error_deg=GRAVITY_DEG)  # type: ignore[arg-type]
        if int(problem.right.sum()) >= LEAST:
            there += 1
            found += len(_verified(problem, generator))
    return found, there


def _verified(problem: Problem, generator: torch.Generator) -> Sequence[VerifiedPair]:
    count = len(problem.right)
    features = [
        Features(pixels, torch.zeros(count, 128), torch.zeros(count, 3, dtype=torch.uint8), torch.ones(count).double())
        for pixels in problem.pixels
    ]
    pair = PairMatches(0, 1, torch.arange(count)[:, None].expand(count, 2))
    initializer = RefractiveInitializer(_capture(problem), problem.index_ratio, SfmOptions())
    return verify_pairs([pair], features, initializer, LEAST, generator, SilentRecorder())


def _capture(problem: Problem) -> Capture:
    """What is known of the two cameras."""
    lens = Intrinsics.create(2, 2, problem.focal, principal_point=(0.0, 0.0))
    return Capture(
        folder=Path(),
        names=("first", "second"),
        paths=(Path("first"), Path("second")),
        cameras=Cameras.of([lens]),
        interfaces=Interfaces.level(problem.index_ratio),
        down_in_cam=problem.down_in_cam,
        down_sigma=torch.full((2,), problem.gravity_sigma).double(),
        height=torch.ones(2).double(),
        has_height=torch.zeros(2, dtype=torch.bool),
        length_unit="m",
    )


if __name__ == "__main__":
    main()
