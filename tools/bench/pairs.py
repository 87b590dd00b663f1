"""Which pairs of photographs are worth matching: how many of those that truly match each way finds, and of how many.

    python tools/bench/pairs.py [--columns 12] [--rows 6] [--obliques 12] [--keypoints 2048] [--cache FOLDER] [--seed 0]

A made river's bed, photographed by a drone in columns x rows photographs straight down, which overlap by 60 % of their
sides, and obliques from around, 480 x 360 pixels each. All pairs are matched; a match is true if its two keypoints show
places that are less than APART m apart, and a pair if it has ENOUGH such matches. `positions, 3 m` and `no heading` are
without what a good receiver or a compass says. Times are of one processor.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from baseline import bench_parser, figure
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.commands.pairs import ChosenPairs, choose_pairs
from torchrefrac.features import Features, MatchOptions, SiftOptions, extract_sift, match
from torchrefrac.features.pairs import best_partners, every_pair, pairs_of
from torchrefrac.files.capture import load_capture
from torchrefrac.files.survey import SURVEY, read_survey
from torchrefrac.files.truth import load_truth_points
from torchrefrac.scene import Capture, TruthPoints, with_measured
from torchrefrac.synthetic.library import made_scene
from torchrefrac.synthetic.options import CameraOptions, SensorOptions
from torchrefrac.synthetic.scenes import RiverbedOptions

APART, ENOUGH = 0.4, 100  # m; true points are known every four pixels, 0.27 m of the ground
CAMERA = CameraOptions(width=480, height=360, fov_deg=65.0)


def main() -> None:
    parser = bench_parser("Recall of the pairs that are worth matching.")
    for name, default in (("columns", 12), ("rows", 6), ("obliques", 12), ("keypoints", 2048), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--cache", type=Path, help="folder of made scenes, by default the user's cache")
    options = parser.parse_args()
    torch.set_num_threads(1)
    size = {"columns": options.columns, "rows": options.rows, "obliques": options.obliques, "seed": options.seed}
    scene = RiverbedOptions(name="pairs", overlap=0.6, camera=CAMERA, sensor=SensorOptions(samples=2), **size)
    folder = made_scene(scene, options.cache)
    capture = load_capture(folder)
    capture = with_measured(capture, read_survey(folder / SURVEY, capture.names))
    truth = load_truth_points(folder, capture.names)
    assert truth is not None
    features = [extract_sift(path, SiftOptions(max_features=options.keypoints)) for path in capture.paths]
    start = time.process_time()
    true = _true_matches(features, truth)
    _show(capture, features, true, time.process_time() - start)


def _show(capture: Capture, features: Sequence[Features], matches: Int[Tensor, "m m"], seconds: float) -> None:
    true = matches >= ENOUGH
    count, partners = int(true.sum()) // 2, true.sum(dim=1)
    pairs = len(capture) * (len(capture) - 1) // 2
    print(
        f"{len(capture)} photographs of {sum(map(len, features)) / len(features):.0f} keypoints, {count} true pairs of "
        f"{pairs}, {int(partners.max())} of a photograph at most; all matched in {seconds:.0f} s"
    )
    generator = torch.Generator().manual_seed(0)
    off = 3.0 * torch.randn(capture.position.shape, generator=generator, dtype=torch.float64)
    rough = replace(capture, position=capture.position + off, position_sigma=torch.full_like(off, 3.0))
    unturned = replace(capture, has_heading=torch.zeros_like(capture.has_heading))
    nowhere = replace(capture, position_sigma=torch.full_like(off, torch.inf))
    ways = {
        "positions": (capture, "positions"),
        "positions, no heading": (unturned, "positions"),
        "positions, 3 m": (rough, "positions"),
        "positions, 3 m, and retrieval": (rough, "auto"),
        "positions and retrieval": (capture, "auto"),
        "retrieval": (nowhere, "retrieval"),
        "retrieval and sequence": (nowhere, "auto"),
        "sequence": (nowhere, "sequence"),
    }
    print(f"{'':<32} {'pairs':>6} {'of all':>7} {'recall':>8} {'choosing':>9}")
    best = pairs_of(best_partners(torch.where(true, matches, 0).double(), MatchOptions().per_image, above=0.0))
    chosen_by = {"the most matches": (ChosenPairs(best, "truth", len(capture)), 0.0)}
    for name, (stated, way) in ways.items():
        chosen_by[name] = _timed(lambda s=stated, w=way: choose_pairs(s, features, MatchOptions(pairs=w), 0))
    for name, (chosen, spent) in chosen_by.items():
        first, second = chosen.pairs.T
        recall = float(true[first, second].sum()) / count
        share = len(chosen.pairs) / pairs
        print(f"{name:<32} {len(chosen.pairs):>6} {100 * share:>6.1f}% {100 * recall:>7.2f}% {spent:>7.2f} s")
        figure(f"{name}: recall", 100.0 * recall, "%", "higher", 0.01)
        figure(f"{name}: pairs", len(chosen.pairs), "pairs", "lower")


def _timed(choose: Callable[[], ChosenPairs]) -> tuple[ChosenPairs, float]:
    start = time.process_time()
    chosen = choose()
    return chosen, time.process_time() - start


def _true_matches(features: Sequence[Features], truth: TruthPoints) -> Int[Tensor, "m m"]:
    """How many of each pair."""
    shown = [_places(of_image, truth, image) for image, of_image in enumerate(features)]
    count = torch.zeros(len(features), len(features), dtype=torch.long)
    for i, j in pairs_of(every_pair(len(features))).tolist():
        matches = match(features[i].unit(), features[j].unit(), MatchOptions())
        apart = (shown[i][matches[:, 0]] - shown[j][matches[:, 1]]).norm(dim=-1)
        count[i, j] = count[j, i] = (apart < APART).sum()
    return count


def _places(features: Features, truth: TruthPoints, image: int) -> Float[Tensor, "k 3"]:
    """What keypoints show; far away, and elsewhere in each image, where nothing is known."""
    height, width = truth.valid.shape[1:]
    column, row = ((features.pixels - truth.offset) / truth.step).round().long().unbind(dim=-1)
    column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    places = truth.points[image, row, column]
    return torch.where(truth.valid[image, row, column][:, None], places, 1e9 * (1 + image))


if __name__ == "__main__":
    main()
