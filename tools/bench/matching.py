"""Matching of two images beside the way it was done before: a chunk of rows at a time, each looked through for its two
largest numbers, in new memory. Both must find the same.

    python tools/bench/matching.py [--keypoints 8192] [--seed 0]

Times are of one processor, the better of several, taken in turns. The products of all descriptors alone, which neither
can do without, are the limit.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import time
from collections.abc import Callable

import torch
from baseline import bench_parser, figure
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.features import MatchOptions, match

TRIES, ROWS = 7, 512


def main() -> None:
    parser = bench_parser("Matching beside the way it was done before.")
    parser.add_argument("--keypoints", type=int, default=8192)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    first, second = _descriptors(options.keypoints, torch.Generator().manual_seed(options.seed))
    ways = {
        "products alone": lambda: _products(first, second),
        "before": lambda: _before(first, second, MatchOptions()),
        "now": lambda: match(first, second, MatchOptions()),
    }
    seconds = {name: float("inf") for name in ways}
    for _ in range(TRIES):
        for name, way in ways.items():
            seconds[name] = min(seconds[name], _processor_time(way))
    found = match(first, second, MatchOptions())
    if not torch.equal(found, _before(first, second, MatchOptions())):
        raise SystemExit("both ways find different matches")
    for name, spent in seconds.items():
        print(f"{name:<15} {spent:.4f} s of processor time")
    ratio = seconds["before"] / seconds["now"]
    print(f"{len(found)} matches of {options.keypoints} keypoints, the same both ways; {ratio:.2f} times as fast")
    figure("as fast as before", ratio, "x", "higher", 0.2)


def _descriptors(count: int, generator: torch.Generator) -> tuple[Float[Tensor, "n 128"], Float[Tensor, "n 128"]]:
    """Two images' descriptors, of which half are of the same places; some are equal."""
    first = torch.rand(count, 128, generator=generator) ** 3
    second = torch.rand(count, 128, generator=generator) ** 3
    noise = 0.05 * torch.randn(count // 2, 128, generator=generator)
    second[: count // 2] = (first[: count // 2] + noise).clamp(min=0.0)
    first[1::64] = first[0::64]
    unit = torch.nn.functional.normalize
    return unit(first, dim=-1), unit(second, dim=-1)


def _products(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> None:
    product = first.new_empty(min(ROWS, len(first)), len(second))
    for start in range(0, len(first), ROWS):
        rows = first[start : start + ROWS]
        torch.mm(rows, second.T, out=product[: len(rows)])


def _before(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"], options: MatchOptions) -> Int[Tensor, "k 2"]:
    best = first.new_full((len(second),), -torch.inf)
    similar, nearest = [], []
    for start in range(0, len(first), ROWS):
        similarity = first[start : start + ROWS] @ second.T
        top = similarity.topk(2, dim=-1)
        similar.append(top.values)
        nearest.append(top.indices[:, 0])
        best = torch.maximum(best, similarity.amax(dim=0))
    target, similarity = torch.cat(nearest), torch.cat(similar)
    squared_distance = (2.0 - 2.0 * similarity).clamp(min=0.0)
    distinct = squared_distance[:, 0] < options.ratio**2 * squared_distance[:, 1]
    rows = torch.arange(len(first))
    agrees = similarity[:, 0] == best[target]
    one = torch.full_like(best, len(rows), dtype=torch.long)
    one.scatter_reduce_(0, target[agrees], rows[agrees], "amin")
    mutual = distinct & (one[target] == rows)
    return torch.stack((rows[mutual], target[mutual]), dim=-1)


def _processor_time(way: Callable[[], object]) -> float:
    start = time.process_time()
    way()
    return time.process_time() - start


if __name__ == "__main__":
    main()
