"""Figures 1, 3 and 5 of the paper (Chang & Chen, ICCV 2011), in which what several models find stands side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from torchrefrac.figures.cameras import colored_heights, draw_path, path_keys, path_limits, pyramids
from torchrefrac.figures.panels import OUTLINE, from_side, oblique, scale_bar
from torchrefrac.figures.plotting import WIDTH, blank_figure, color_bar, height_colors, legend_above
from torchrefrac.figures.side_views import INK, WATER, SideFrame, SideView, outlines
from torchrefrac.files.photographs import read_color
from torchrefrac.scene import Scene, Truth
from torchrefrac.scene.wording import Wording

PLANE = "#d9dee2"
SCALE_ROOM = 0.08  # of the height of an oblique view, under the points


def photograph_and_models_figure(photograph: Path, views: Sequence[SideView], truth: Truth | None) -> Any:
    """Figure 1: a photograph, and beside it what models find in it, seen from the side and coloured by height.

    Two panels a row; one scale for all reconstructions.
    """
    frame, rows = SideFrame.of(views, truth, height_colors()), 1 + len(views) // 2
    figure = blank_figure(WIDTH, 0.6 + rows * (0.95 + 0.37 * WIDTH * frame.tall))
    grid = figure.subplots(rows, 2, squeeze=False).flatten()
    for panel in grid[1 + len(views) :]:
        panel.set_visible(False)
    draw_photograph(grid[0], photograph)
    for panel, view in zip(grid[1 : 1 + len(views)], views, strict=True):
        frame.draw(panel, view)
    _letter(grid[: 1 + len(views)], ("A photograph", *(view.title for view in views)))
    frame.explain(figure, list(grid[1 : 1 + len(views)]), views)
    return figure


def setup_figure(true: Scene, truth: Truth, photograph: Path, words: Wording) -> Any:
    """Figure 3: the true planes with the cameras above them, obliquely, and one of the photographs.

    true: the scene as it was, of which the cameras are drawn.
    """
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - slow to import
    from matplotlib.patches import Patch  # noqa: PLC0415

    figure = blank_figure(WIDTH, 0.42 * WIDTH)
    setup, picture = figure.subplots(1, 2)
    frame = oblique(from_side(truth, words))
    planes = outlines(truth)
    for corners in planes[planes[..., 2].mean(dim=1).argsort()]:  # those that stand on others after these
        setup.fill(*(corners @ frame.mT)[:, :2].T.numpy(), fc=PLANE, ec=OUTLINE, lw=1.2, zorder=1)
    shown = torch.cat((planes.flatten(0, 1), true.views.center))[:, :2]
    low, high = shown.amin(dim=0), shown.amax(dim=0)
    corners = torch.stack((low, torch.stack((high[0], low[1])), high, torch.stack((low[0], high[1]))))
    handles = [*path_keys(None), Patch(fc=PLANE, ec=OUTLINE, label="planes")]
    if words.surface:
        surface = torch.nn.functional.pad(corners, (0, 1)) @ frame.mT
        setup.fill(*surface[:, :2].T.numpy(), fc=f"{WATER}22", ec=WATER, lw=1.0, zorder=2)
        handles.append(Patch(fc=f"{WATER}22", ec=WATER, label=words.surface))
    centers = true.views.center @ frame.mT
    setup.plot(*centers[:, :2].T.numpy(), "-", color=WATER, lw=0.8, zorder=3)
    lines = (pyramids(true) @ frame.mT)[..., :2].numpy()
    setup.add_collection(LineCollection(list(lines), colors=INK, linewidths=0.9, zorder=4))
    setup.set(aspect="equal")
    setup.margins(0.04)
    scale_bar(setup, setup.get_xlim(), setup.get_ylim(), true.length_unit)
    setup.spines[:].set_visible(False)
    draw_photograph(picture, photograph)
    _letter((setup, picture), (f"{len(planes)} planes and {len(true.views)} cameras", "A photograph"))
    legend_above(figure, handles)
    return figure


def paths_figure(scenes: Mapping[str, Scene], truth: Truth | None, words: Wording) -> Any:
    """Figure 5: cameras with their path and points coloured by height, a column a model, by their titles.

    Obliquely, and underneath from the side; one scale for all.
    """
    shown, unit = list(scenes.values()), next(iter(scenes.values())).length_unit
    colored = colored_heights(shown)
    side = from_side(truth, words)
    frames = (oblique(side), side)
    limits = [path_limits(shown, truth, frame) for frame in frames]
    limits[0][1][0] -= SCALE_ROOM * (limits[0][1][1] - limits[0][1][0])
    tall = [(y[1] - y[0]) / (x[1] - x[0]) for x, y in limits]
    width = 1.2 * WIDTH
    figure = blank_figure(width, 1.1 + sum(tall) * (width - 1.4) / len(shown))
    grid = figure.subplots(2, len(shown), squeeze=False, gridspec_kw={"height_ratios": tall})
    for panels, frame, (x, y) in zip(grid, frames, limits, strict=True):
        for panel, scene in zip(panels, shown, strict=True):
            draw_path(panel, scene, truth, frame, colored)
            panel.set(xlim=x, ylim=y, aspect="equal")
            panel.tick_params(labelsize=8)
    across, upwards = limits[0]
    for panel in grid[0]:
        scale_bar(panel, across, upwards, unit)
        panel.spines[:].set_visible(False)
    for panel in grid[1]:
        panel.set_xlabel(f"{words.across} ({unit})", fontsize=9)
    grid[1][0].set_ylabel(f"{words.up} ({unit})", fontsize=9)
    _letter(grid[0], tuple(scenes))
    color_bar(figure, colored, list(grid.flat), f"{words.z} ({unit})")
    legend_above(figure, path_keys(truth))
    return figure


def draw_photograph(panel: Any, path: Path) -> None:
    """A photograph in its colours, in pixels."""
    image = read_color(path)[..., ::-1]
    height, width = image.shape[:2]
    panel.imshow(image, extent=(0, width, height, 0), interpolation="antialiased")
    panel.set(xlabel="x (px)", ylabel="y (px)")
    panel.tick_params(labelsize=8)


def _letter(panels: Sequence[Any], titles: Sequence[str]) -> None:
    for i, (panel, title) in enumerate(zip(panels, titles, strict=True)):
        panel.set_title(f"({chr(ord('a') + i)}) {title}", fontsize=11)
