"""Many small adjustments as one layer, forward and backward.

    python tools/bench/many.py [--problems 64] [--views 5] [--points 100] [--seed 0]

Time of one processor, the best of several, of `adjust_each` from poses off by half a degree and a centimetre, and of
the gradient of its points and centres in all pixels and weights.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import time

import torch
from baseline import bench_parser, figure
from jaxtyping import Float
from torch import Tensor

from torchrefrac import BundleBatch, FlatInterface, Intrinsics, RefractiveCamera, adjust_each
from torchrefrac.geometry import so3_exp

TRIES = 4


def main() -> None:
    parser = bench_parser("Many small adjustments.")
    for name, default in (("problems", 64), ("views", 5), ("points", 100), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    torch.set_num_threads(1)
    problems = _problems(options.problems, options.views, options.points, options.seed)
    best, share = [float("inf")] * 2, 0.0
    for _ in range(TRIES):
        start = time.process_time()
        found = adjust_each(problems)
        middle = time.process_time()
        share = 100.0 * float(found.converged.double().mean())
        share = 100.0 * float(found.converged.double().mean())
        (found.points.square().sum() + found.cameras.center_in_world.square().sum()).backward()
        end = time.process_time()
        best = [min(best[0], middle - start), min(best[1], end - middle)]
    size = f"{options.problems} problems of {options.views} views and {options.points} points"
    print(f"{size}, {share:.0f} % converged: forward {best[0]:.2f} s, backward {best[1]:.2f} s of one processor")
    figure("forward and backward", sum(best), "s", "lower", 0.3)


def _problems(count: int, views: int, points: int, seed: int) -> BundleBatch:
    """In metres: cameras a metre above the water, points half a metre below it; pixels good to 0.3."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Float[Tensor, "..."]:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    rotation = so3_exp(0.2 * normal(count, views, 3)) @ down
    height = 1.0 + 0.1 * normal(count, views, 1).clamp(-3.0, 3.0)
    center = torch.cat((0.4 * normal(count, views, 2), height), dim=-1)
    depth = 0.5 + 0.1 * normal(count, points, 1).clamp(-3.0, 3.0)
    seen = torch.cat((0.4 * normal(count, points, 2), -depth), dim=-1)
    lens, water = Intrinsics.create(1000, 1000, 700.0), FlatInterface(1.333)
    pixels, valid = RefractiveCamera(lens, rotation, center, water)[..., None].project(seen[:, None])
    rough = so3_exp(0.01 * normal(count, views, 3)) @ rotation
    start = RefractiveCamera(lens, rough, center + 0.01 * normal(count, views, 3), water)
    return BundleBatch(
        start,
        seen + 0.02 * normal(count, points, 3),
        (pixels + 0.3 * normal(*pixels.shape)).requires_grad_(),
        valid.double().requires_grad_(),
        -rotation[..., 2],
        0.001,
    )


if __name__ == "__main__":
    main()
