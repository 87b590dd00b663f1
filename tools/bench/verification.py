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
    print(f"{'pairs':<40}{'ms a pair':>12}{'verified':>10}")
    for matches, wrong in ((300, 0.2), (3000, 0.2), (60, 1.0), (150, 1.0), (300, 1.0)):
        _report_time(matches, wrong, arguments)
    found = [_recall(arguments, geometry) for geometry in GEOMETRIES]
    share = sum(there for there, _ in found) / sum(count for _, count in found)
    print(f"recall of {sum(count for _, count in found)} pairs, 15 to 50 % of 40 to 80 matches wrong: {share:.2%}")
    figure("recall", share, "", "higher", 0.002)


def _report_time(matches: int, wrong: float, arguments: argparse.Namespace) -> None:
    """Seconds of the processor, not of the clock: other processes hardly change them."""
    label = f"{'true' if wrong < 1.0 else 'wrong'}, {matches} matches"
    seconds, verified = 0.0, 0
    for geometry in GEOMETRIES:
        problems = [
            make_problem(geometry, matches, _generator(seed), outliers=wrong, gravity_error_deg=GRAVITY_DEG)
            for seed in range(arguments.pairs)
        ]
        start = time.process_time()
        verified += len(_verified(problems))
        seconds += time.process_time() - start
    each, share = (total / (arguments.pairs * len(GEOMETRIES)) for total in (1e3 * seconds, verified))
    print(f"{label:<40}{each:>12.1f}{share:>10.1%}", flush=True)
    figure(f"{label}: processor time", each, "ms", "lower", 0.3)


def _recall(arguments: argparse.Namespace, geometry: str) -> tuple[int, int]:
    """Pairs that were found, of how many."""
    problems = []
    for seed in range(arguments.recall):
        generator = _generator(10_000 + seed)
        matches = int(torch.randint(40, 81, (), generator=generator))
        wrong = 0.15 + 0.35 * float(torch.rand((), generator=generator))
        problem = make_problem(geometry, matches, generator, outliers=wrong, gravity_error_deg=GRAVITY_DEG)  # type: ignore[arg-type]
        if int(problem.right.sum()) >= LEAST:
            problems.append(problem)
    return len(_verified(problems)), len(problems)


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _verified(problems: Sequence[Problem]) -> Sequence[VerifiedPair]:
    features = [
        Features(
            at, torch.zeros(len(at), 128), torch.zeros(len(at), 3, dtype=torch.uint8), torch.ones(len(at)).double()
        )
        for problem in problems
        for at in problem.pixels
    ]
    pairs = [
        PairMatches(2 * i, 2 * i + 1, torch.arange(len(problem.right))[:, None].expand(-1, 2))
        for i, problem in enumerate(problems)
    ]
    initializer = RefractiveInitializer(_capture(problems), problems[0].index_ratio, SfmOptions())
    return verify_pairs(pairs, features, initializer, LEAST, _generator(0), SilentRecorder())


def _capture(problems: Sequence[Problem]) -> Capture:
    """What is known of the two cameras of each."""
    lens, count = Intrinsics.create(2, 2, problems[0].focal, principal_point=(0.0, 0.0)), 2 * len(problems)
    names = tuple(map(str, range(count)))
    return Capture(
        folder=Path(),
        names=names,
        paths=tuple(map(Path, names)),
        cameras=Cameras.of([lens]),
        interfaces=Interfaces.level(problems[0].index_ratio),
        down_in_cam=torch.cat([problem.down_in_cam for problem in problems]),
        down_sigma=torch.full((count,), problems[0].gravity_sigma).double(),
        height=torch.ones(count).double(),
        has_height=torch.zeros(count, dtype=torch.bool),
        length_unit="m",
    )


if __name__ == "__main__":
    main()
