"""Sections across the surface: height over distance, with its uncertainty and the level of the water."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.figures.plotting import (
    ESTIMATE,
    PALE,
    TEXT,
    UNKNOWN,
    blank_figure,
    height_colors,
    plain_axes,
    rounded,
    save,
)
from torchrefrac.scene.raster import Raster
from torchrefrac.scene.wording import OF_WATER, Wording

PLACES = (0.25, 0.5, 0.75)  # of the way along the surface, where it is cut across
BAND = 2.0  # standard deviations on either side
WATER, PLAN_INCHES, INCHES = "#2b7bba", 3.4, (9.0, 5.4)
MOST_PIXELS, MOST_SAMPLES = 600, 2000


@dataclass(frozen=True)
class Profile:
    """Along a straight line from start to end (x, y): distances, heights and their sigmas; NaN where there is no
    surface."""

    name: str
    start: tuple[float, float]
    end: tuple[float, float]
    distance: Float[Tensor, " n"]
    height: Float[Tensor, " n"]
    sigma: Float[Tensor, " n"]


def profiles(raster: Raster) -> list[Profile]:
    """Three sections across the direction in which the surface is longest, as of a river; fewer where there is nothing
    to cut. Heights are those of the cells that lines run through."""
    row, column = raster.valid.nonzero().unbind(dim=-1)
    if len(row) < 2:
        return []
    points = torch.stack((raster.x[column], raster.y[row]), dim=-1)
    middle = points.mean(dim=0)
    along = torch.linalg.eigh((points - middle).T @ (points - middle))[1][:, 1]
    along = along * torch.where(along[along.abs().argmax()] > 0.0, 1.0, -1.0)
    across = torch.stack((-along[1], along[0]))
    way, side = (points - middle) @ along, (points - middle) @ across
    low, high = way.min(), way.max()
    found = []
    for name, place in zip("ABC", PLACES, strict=True):
        at = low + place * (high - low)
        near = (way - at).abs() <= raster.cell_size
        if not bool(near.any()):
            continue
        start, end = (middle + at * along + reach * across for reach in (side[near].min(), side[near].max()))
        found.append(_profile(name, raster, start, end))
    return [profile for profile in found if float(profile.distance[-1]) > 0.0]


def _profile(name: str, raster: Raster, start: Float[Tensor, " 2"], end: Float[Tensor, " 2"]) -> Profile:
    length = float((end - start).norm())
    count = min(max(2, math.ceil(length / raster.cell_size) + 1), MOST_SAMPLES)
    share = torch.linspace(0.0, 1.0, count, dtype=start.dtype)
    row, column = raster.grid.cells_of(start + share[:, None] * (end - start))
    valid = raster.valid[row, column]
    height, sigma = (grid[row, column].where(valid, torch.nan) for grid in (raster.height, raster.sigma))
    first, last = ((float(point[0]), float(point[1])) for point in (start, end))
    return Profile(name, first, last, share * length, height, sigma)


def draw_profiles(raster: Raster, path: Path, words: Wording = OF_WATER) -> bool:
    """Draw where the surface is cut, and the sections below each other with one scale; whether there are any."""
    every = profiles(raster)
    if not every:
        return False
    unit = raster.length_unit
    figure = blank_figure(*INCHES)
    grid = figure.add_gridspec(len(every), 2, width_ratios=(PLAN_INCHES, INCHES[0] - PLAN_INCHES))
    _draw_plan(figure.add_subplot(grid[:, 0]), raster, every, words)
    longest = max(float(profile.distance[-1]) for profile in every)
    heights = torch.cat([profile.height for profile in every])
    heights = heights[heights.isfinite()]
    low, high = float(heights.min()), float(heights.max())
    if words.surface:
        low, high = min(low, 0.0), max(high, 0.0)
    margin = 0.08 * max(high - low, 1e-9)
    for i, profile in enumerate(every):
        panel = figure.add_subplot(grid[i, 1])
        plain_axes(panel)
        distance, height, sigma = (values.cpu().numpy() for values in (profile.distance, profile.height, profile.sigma))
        if words.surface:
            panel.axhline(0.0, color=WATER, lw=1.0)
        panel.fill_between(distance, height - BAND * sigma, height + BAND * sigma, color=PALE, lw=0.0)
        panel.plot(distance, height, color=ESTIMATE, lw=1.2)
        panel.set(xlim=(0.0, longest), ylim=(low - margin, high + margin), ylabel=f"{words.z} ({unit})")
        if words.is_wall:
            panel.yaxis.label.set_size(8)
        panel.set_title(f"{profile.name} to {profile.name}'", loc="left", fontsize=9, color=TEXT, pad=3.0)
        if i == len(every) - 1:
            panel.set_xlabel(f"distance ({unit})")
        else:
            panel.tick_params(labelbottom=False)
    typical = raster.sigma[raster.valid].median()
    sigma = rounded(float(typical)) if len(heights) else UNKNOWN
    line = f"; blue: {words.glass}" if words.surface else ""
    drawn = _exaggeration(longest, high - low + 2.0 * margin, len(every))
    figure.suptitle(
        f"Sections across the surface, {words.relief} {drawn}; pale: ± {BAND:g} standard deviations ({sigma} {unit} "
        f"each, median){line}",
        fontsize=9, color=TEXT,
    )  # fmt: skip
    save(figure, path)
    return True


def _exaggeration(length: float, height: float, count: int) -> str:
    """By what factor heights are drawn larger than distances, or smaller."""
    across, up = 0.88 * (INCHES[0] - PLAN_INCHES), 0.78 * INCHES[1] / count
    factor = up / height * length / across
    return f"{rounded(factor)} times exaggerated" if factor >= 1.0 else f"{rounded(1.0 / factor)} times compressed"


def _draw_plan(panel: Any, raster: Raster, every: list[Profile], words: Wording) -> None:
    step = max(1, math.ceil(max(raster.height.shape) / MOST_PIXELS))
    depth, valid = raster.depth[::step, ::step].cpu(), raster.valid[::step, ::step].cpu()
    shown = depth.where(valid, torch.nan).numpy()
    size = raster.cell_size * step
    extent = (
        raster.x_west, raster.x_west + size * shown.shape[1], raster.y_north - size * shown.shape[0], raster.y_north
    )  # fmt: skip
    panel.imshow(shown, extent=extent, cmap=height_colors().reversed(), interpolation="nearest")
    for profile in every:
        (x0, y0), (x1, y1) = profile.start, profile.end
        panel.plot((x0, x1), (y0, y1), color=TEXT, lw=1.2)
        for x, y, name in ((x0, y0, profile.name), (x1, y1, f"{profile.name}'")):
            panel.annotate(
                name, (x, y), fontsize=9, color=TEXT, ha="center", va="center",
                bbox={"boxstyle": "circle,pad=0.15", "fc": "white", "ec": TEXT, "lw": 0.6},
            )  # fmt: skip
    unit = raster.length_unit
    panel.set_title(f"{words.dark}, white has no surface", fontsize=9, color=TEXT, pad=8.0)
    panel.set(aspect="equal", xlabel=f"x ({unit})", ylabel=f"{words.y} ({unit})")
    panel.tick_params(labelsize=8, colors=TEXT)
