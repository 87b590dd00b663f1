"""Draw the figures of docs/solvers.md, on the problems of tools/bench/solver_problems.py.

python -m tools.figures.solvers [docs/figures], from the root of the repository
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from torch import Tensor

import torchrefrac as tr
from tools.bench.solver_problems import GEOMETRIES, PIXEL_SIGMA, Geometry, Problem, make_problem
from torchrefrac.geometry import level_rotation
from torchrefrac.ransac import level_rays
from torchrefrac.ransac.degeneracy import MAX_UNCERTAINTY

COLORS = {"tank": "#1b3a57", "drone": "#c0392b"}
WATER = 1.333
GRAVITY_DEG = 2.0
MAX_ERROR = 2.0
NOISE = (0.05, 0.1, 0.2, 0.5, 1.0)
MATCHES = (50, 100, 200, 500, 1000, 2000)
ABOVE_ONE = tuple(10.0 ** (-3.0 + 0.1 * k) for k in range(28))


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the figures of docs/solvers.md.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/figures"))
    folder = parser.parse_args().folder
    torch.set_num_threads(1)
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    for name, draw in (("minimal", draw_minimal), ("refinement", draw_refinement), ("index", draw_index)):
        figure = draw()
        figure.savefig(folder / f"solvers_{name}.png", dpi=130)
        plt.close(figure)
        print(folder / f"solvers_{name}.png")


def draw_minimal(problems: int = 500) -> Figure:
    """Median position error of four and of seven pairs of the same noisy samples."""
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    for geometry in GEOMETRIES:
        errors = torch.tensor([_minimal_errors(geometry, noise, problems) for noise in NOISE])
        for error, label, style in zip(errors.T, ("7-point", "4-point"), ("s--", "o-"), strict=True):
            axes.plot(NOISE, 100.0 * error, style, color=COLORS[geometry], ms=5, label=f"{geometry}, {label}")
    axes.set(xlabel="noise of a pixel coordinate (px)", ylabel="median position error (% of the baseline)")
    axes.set_title("Minimal samples, gravity exact")
    _logarithmic(axes, NOISE)
    axes.set_yticks((0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0))
    return figure


def _minimal_errors(geometry: Geometry, noise: float, problems: int) -> tuple[float, float]:
    """Medians over the problems of the best candidate from seven pairs and from the first four of them.

    The seven are solved by `relative_pose_npt`: with noise some of seven right pairs meet above the water, for which
    `relative_pose_7pt` gives no candidate.
    """
    drawn = [make_problem(geometry, 7, torch.Generator().manual_seed(k), noise=noise) for k in range(problems)]
    one, two = (torch.stack(part) for part in zip(*(_level_rays(problem) for problem in drawn), strict=True))
    truth = torch.stack([problem.true_model() for problem in drawn])
    baseline = torch.tensor([problem.baseline for problem in drawn], dtype=torch.float64)
    height = torch.tensor([float(problem.center[0, 2]) for problem in drawn], dtype=torch.float64)
    medians = []
    for count, solve in ((7, tr.minimal.relative_pose_npt), (4, tr.minimal.relative_pose_4pt)):
        _, center, valid = solve(one[:, :count], two[:, :count], drawn[0].index_ratio, height)
        error = (center - truth[:, None, 5:]).norm(dim=-1) / baseline[:, None]
        medians.append(float(torch.where(valid, error, torch.inf).amin(dim=-1).median()))
    return medians[0], medians[1]


def draw_refinement(problems: int = 100) -> Figure:
    """RMS position error of linear and refined poses, and the Cramér-Rao bound, against the number of matches."""
    figure, panels = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained", sharey=True)
    for axes, geometry in zip(panels, GEOMETRIES, strict=True):
        for gravity_deg, color, label in (
            (0.0, COLORS["tank"], "gravity exact"),
            (GRAVITY_DEG, COLORS["drone"], f"gravity {GRAVITY_DEG:g}° off"),
        ):
            errors = torch.tensor([_refined_errors(geometry, count, gravity_deg, problems) for count in MATCHES])
            linear, refined, bound = 100.0 * errors.square().mean(dim=1).sqrt().T
            if gravity_deg == 0.0:
                axes.plot(MATCHES, linear, "s:", color="0.5", ms=4, lw=1.0, label=f"linear n-point, {label}")
            axes.plot(MATCHES, refined, "o", color=color, ms=6, label=f"refined, {label}")
            axes.plot(MATCHES, bound, "-", color=color, lw=1.2, label=f"Cramér-Rao bound, {label}")
        axes.set(xlabel="matches", title=f"{geometry}, {PIXEL_SIGMA:g} px", ylim=(0.04, 60.0))
        _logarithmic(axes, MATCHES)
    panels[0].set_ylabel("RMS position error (% of the baseline)")
    panels[1].get_legend().remove()
    return figure


def _refined_errors(geometry: Geometry, count: int, gravity_deg: float, problems: int) -> list[tuple[float, ...]]:
    """Position errors of the linear pose and of the minimum next to the truth, and their bound, of each problem."""
    rows = []
    for seed in range(problems):
        generator = torch.Generator().manual_seed(seed)
        problem = make_problem(geometry, count, generator, gravity_error_deg=gravity_deg)
        # An angle in a random direction is 1 / sqrt(2) of it about each of the two axes of a tilt.
        problem = replace(problem, gravity_sigma=problem.gravity_sigma / math.sqrt(2.0))
        height, truth = float(problem.center[0, 2]), problem.true_model()
        heading, center, _ = tr.minimal.relative_pose_npt(*_level_rays(problem), problem.index_ratio, height)
        linear = torch.cat((truth[:4], heading[:1], center[0]))
        refined = problem.two_views().refine(truth[None], MAX_ERROR, 20).states[0]
        rows.append((problem.relative_errors(linear)[0], problem.relative_errors(refined)[0], _bound(problem)))
    return rows


def draw_index(problems: int = 20, count: int = 1000) -> Figure:
    """How well the position of the second camera can be known, against the index ratio."""
    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for geometry in GEOMETRIES:
        for gravity_deg, style, label in ((0.0, "-", "gravity exact"), (GRAVITY_DEG, "--", f"{GRAVITY_DEG:g}° off")):
            bounds = [
                [_bound(_with_index(geometry, count, gravity_deg, 1.0 + above, seed)) for seed in range(problems)]
                for above in ABOVE_ONE
            ]
            median = 100.0 * torch.tensor(bounds).median(dim=1).values
            axes.plot(ABOVE_ONE, median, style, color=COLORS[geometry], label=f"{geometry}, {label}")
    limit = 100.0 * MAX_UNCERTAINTY
    axes.axhline(limit, color="0.4", lw=1.0, ls=":")
    axes.text(0.5, 1.15 * limit, "above: degenerate", ha="right", color="0.3")
    axes.axvline(WATER - 1.0, color="#9cc6e2", lw=1.0)
    axes.text(WATER - 1.01, 0.045, "water", ha="right", color="#3b7ea8")
    axes.set(xlabel="index ratio", ylabel="uncertainty of the position (% of the baseline)")
    axes.set_title(f"Cramér-Rao bound, {count} matches, {PIXEL_SIGMA:g} px")
    _logarithmic(axes, (0.001, 0.003, 0.01, 0.03, 0.1, WATER - 1.0))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda above, _: f"{1.0 + above:.4g}"))
    return figure


def _with_index(geometry: Geometry, count: int, gravity_deg: float, index_ratio: float, seed: int) -> Problem:
    generator = torch.Generator().manual_seed(seed)
    return make_problem(geometry, count, generator, gravity_error_deg=gravity_deg, index_ratio=index_ratio)


def _bound(problem: Problem) -> float:
    """Cramér-Rao bound of the position of the second camera, over the baseline."""
    views, truth = problem.two_views(), problem.true_model()[None]
    covariance = torch.linalg.inv(views.linearize(truth, math.inf).hessian[0]) * views.pixel_sigma**2
    return float(covariance.diagonal()[5:].sum().sqrt()) / problem.baseline


def _level_rays(problem: Problem) -> tuple[Tensor, Tensor]:
    one, two = map(level_rays, problem.plane, level_rotation(problem.down_in_cam))
    return one, two


def _logarithmic(axes: Axes, ticks: tuple[float, ...]) -> None:
    """Both axes, with plain numbers, a light grid and a legend."""
    axes.set(xscale="log", yscale="log")
    axes.set_xticks(ticks)
    axes.minorticks_off()
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(True, color="0.9")
    axes.legend(frameon=False, fontsize=9)


if __name__ == "__main__":
    main()
