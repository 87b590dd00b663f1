"""How many shuffled batches of rays a second a training gets.

    python tools/bench/rays.py RUN [--batch 4096] [--workers 2] [--batches 500]

RUN: folder of a run with its photographs. Batches only come out, nothing is learnt; the photographs have been read once
before, as they have after the first batches of any training.
"""

import time
from pathlib import Path

from baseline import bench_parser, figure


def main() -> None:
    parser = bench_parser("Batches of rays a second.")
    parser.add_argument("run", type=Path, help="folder of a run")
    parser.add_argument("--batch", type=int, default=4096)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--batches", type=int, default=500)
    options = parser.parse_args()

    from torchrefrac import RefractiveRays  # noqa: PLC0415 - after the help

    rays = RefractiveRays(options.run)
    loader = iter(rays.loader(options.batch, workers=options.workers))
    next(loader)  # workers have begun
    start, seen = time.perf_counter(), 0
    for _ in zip(range(options.batches), loader, strict=False):
        seen += 1
    rate = seen / (time.perf_counter() - start)
    print(f"{rate:.0f} batches of {options.batch} rays a second, {options.workers} workers, {len(rays)} rays")
    figure("batches a second", rate, "", "higher", 0.3)


if __name__ == "__main__":
    main()
