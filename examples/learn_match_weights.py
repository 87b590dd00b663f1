"""Learn what a match is worth, end to end through the adjustment.

    python examples/learn_match_weights.py [--steps 120]

Three cameras look into water at twenty points. Every match comes with two things that a matcher knows: the ratio of its
descriptor's distance to that of the second nearest, and the size of its keypoint. One match in eight is wrong, and the
others are the less exact the larger their keypoints are, but how all this hangs together nobody says. A small network
gives each match a weight, `tr.adjust_each` adjusts many such triples at once, and the error of the cameras goes back
through the adjustment into the network: no match is ever labelled right or wrong.
"""

import argparse
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn
from tqdm import tqdm

import torchrefrac as tr
from torchrefrac.geometry import so3_exp
from torchrefrac.optim import LossName

VIEWS, POINTS = 3, 20
WRONG = 0.125  # of all matches
EQUAL: tuple[LossName, ...] = ("squared", "huber", "cauchy")  # losses that are compared
LEARNT: tuple[LossName, ...] = ("squared", "cauchy")
FIXED = torch.zeros(VIEWS, 6, dtype=torch.bool)  # rotation and centre of each camera
FIXED[0], FIXED[1, 3] = True, True  # the first is known, and how far along x the second is from it


class Batch(NamedTuple):
    """Triples of photographs with all weights 1, what is known of their matches, and where cameras truly stand."""

    problems: tr.BundleBatch
    features: Tensor
    center: Tensor


def main() -> None:
    parser = argparse.ArgumentParser(description="Learn weights of matches through the adjustment.")
    parser.add_argument("--steps", type=int, default=120, help="steps of Adam")
    arguments = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    networks: dict[LossName, nn.Module] = {loss: learn_weights(loss, arguments.steps, generator) for loss in LEARNT}
    compare(networks, draw_problems(500, generator))


def learn_weights(loss: LossName, steps: int, generator: torch.Generator, triples: int = 32) -> nn.Module:
    """A network from features (..., 2) to logarithms of weights (..., 1), trained on new triples at each step.

    loss: of the adjustment; that of the network is the logarithm of the error of the cameras.
    """
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(2, 16), nn.SiLU(), nn.Linear(16, 16), nn.SiLU(), nn.Linear(16, 1)).double()
    optimizer = torch.optim.Adam(network.parameters(), lr=0.03)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in tqdm(range(steps), desc=f"loss {loss}", unit="step", leave=False):
        batch = draw_problems(triples, generator)
        error, converged = camera_errors(batch, weights_of(network, batch.features), loss)
        optimizer.zero_grad()
        error.log()[converged].mean().backward()
        optimizer.step()
        schedule.step()
    return network


def weights_of(network: nn.Module, features: Tensor) -> Tensor:
    """Weights (b, m, n), whose mean is 1 in each triple."""
    weights = network(features)[..., 0].exp()
    return weights / weights.mean(dim=(1, 2), keepdim=True)


def camera_errors(batch: Batch, weights: Tensor, loss: LossName) -> tuple[Tensor, Tensor]:
    """RMS error of the positions of the second and third camera in each triple, and whether it has converged."""
    found = tr.adjust_each(
        replace(batch.problems, weights=weights), loss=loss, fixed=FIXED, max_iterations=30, tolerance=1e-7
    )
    miss = (found.cameras.center_in_world - batch.center)[:, 1:]
    return miss.square().sum(dim=-1).mean(dim=-1).sqrt(), found.converged


@torch.no_grad()
def compare(networks: dict[LossName, nn.Module], batch: Batch) -> None:
    """Print errors on triples that no network has seen, and a few weights of the one with a Cauchy loss."""
    print(f"{len(batch.center)} held-out triples        median error   nine in ten below")
    for loss in EQUAL:
        _report(f"equal weights, {loss}", camera_errors(batch, batch.problems.weights, loss)[0])
    for loss, network in networks.items():
        _report(f"learnt weights, {loss}", camera_errors(batch, weights_of(network, batch.features), loss)[0])
    ratio, size = torch.tensor([0.4, 0.55, 0.7, 0.8]).double(), torch.tensor([2.0, 4.0, 8.0]).double()
    worth = networks["cauchy"](described(*torch.meshgrid(ratio, size, indexing="ij")))[..., 0].exp()
    print("what these weights are, relative to a match of ratio 0.4 and size 2")
    print("size        " + "".join(f"{float(each):10.0f}" for each in size))
    for each, row in zip(ratio, worth / worth[0, 0], strict=True):
        print(f"ratio {float(each):.2f}  " + "".join(f"{float(value):10.4f}" for value in row))


def _report(name: str, error: Tensor) -> None:
    print(f"{name:<24} {1000 * error.median():9.1f} mm {1000 * error.quantile(0.9):15.1f} mm")


def described(ratio: Tensor, size: Tensor) -> Tensor:
    """Features of matches, about as large as 1."""
    return torch.stack((6.0 * (ratio - 0.6), size.log2() - 2.0), dim=-1)


def draw_problems(count: int, generator: torch.Generator) -> Batch:
    """Triples of cameras about a metre above the water over points at depths of 0.3 to 0.8 m, and their matches."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    looking = so3_exp(0.2 * normal(count, VIEWS, 3)) @ torch.diag(torch.tensor([1.0, -1.0, -1.0]).double())
    place = torch.tensor([[-0.5, 0.0], [0.5, 0.0], [0.0, 0.6]]).double() + 0.1 * normal(count, VIEWS, 2)
    center = torch.cat((place, 1.0 + 0.4 * uniform(count, VIEWS, 1)), dim=-1)
    points = torch.cat((0.4 * normal(count, POINTS, 2), -0.3 - 0.5 * uniform(count, POINTS, 1)), dim=-1)
    lens = tr.Intrinsics.create(1000, 1000, focal=600.0)
    cameras = tr.RefractiveCamera(lens, looking, center, tr.FlatInterface(index_ratio=1.333))
    pixels, _ = cameras[..., None].project(points[:, None])
    each = count, VIEWS, POINTS
    wrong, size = uniform(*each) < WRONG, 2.0 ** (1.0 + 2.0 * uniform(*each))
    ratio = torch.where(wrong, 0.8 - 0.3 * uniform(*each).square(), 0.8 - 0.6 * uniform(*each).sqrt())
    noise = torch.where(wrong, 12.0, 0.15 * size)  # pixels
    measured = pixels + noise[..., None] * normal(*each, 2)
    turn, shift = (0.01 * ~FIXED * normal(count, VIEWS, 6)).split(3, dim=-1)
    guess = replace(cameras, cam_from_world_rotation=so3_exp(turn) @ looking, center_in_world=center + shift)
    start = points + 0.01 * normal(*points.shape)
    ones = torch.ones(each, dtype=torch.float64)
    return Batch(tr.BundleBatch(guess, start, measured, ones), described(ratio, size), center)


if __name__ == "__main__":
    main()
