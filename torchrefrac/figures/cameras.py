"""The paper's Figure 5: where the cameras were, and what they saw."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.figures import plotting
from torchrefrac.figures.panels import OUTLINE, TO_FRONT_DEG, TURN_DEG, from_side, oblique
from torchrefrac.figures.plotting import SECOND, WIDTH, blank_figure, height_colors, legend_above, legend_key
from torchrefrac.figures.side_views import INK, WATER, outlines
from torchrefrac.scene import Scene, Truth
from torchrefrac.scene.wording import Wording

SLIM, TALL = 0.35, 1.15  # a panel, its height over its width
TAILS = (0.01, 0.99)


def cameras_figure(shown: Scene, truth: Truth | None, words: Wording) -> Any:
    """Cloud and cameras along z and obliquely, one panel each, the cameras as the pyramids of what they see.

    A line joins the cameras in the order of the images; crosses are the true centres, where `truth` has them.
    """
    unit, colored = shown.length_unit, colored_heights([shown])
    frames = (
        torch.eye(3, dtype=torch.float64),
        oblique(from_side(None, words), TO_FRONT_DEG if words.is_wall else -TURN_DEG),
    )
    limits = [path_limits([shown], truth, frame) for frame in frames]
    widths = [x[1] - x[0] for x, _ in limits]
    tall = max((y[1] - y[0]) / (x[1] - x[0]) for x, y in limits)
    figure = blank_figure(WIDTH + 1.0, 0.9 + 0.45 * WIDTH * min(max(tall, SLIM), TALL))
    views = figure.subplots(1, 2, gridspec_kw={"width_ratios": [math.sqrt(w / max(widths)) for w in widths]})
    for panel, frame, (x, y) in zip(views, frames, limits, strict=True):
        draw_path(panel, shown, truth, frame, colored)
        panel.set(xlim=x, ylim=y, aspect="equal")
        panel.tick_params(labelsize=8)
    views[0].set_title(words.along_z, fontsize=11)
    views[0].set(xlabel=f"x ({unit})", ylabel=f"{words.y} ({unit})")
    views[1].set_title("obliquely", fontsize=11)
    views[1].set(xticks=[], yticks=[])
    views[1].spines[:].set_visible(False)
    plotting.color_bar(figure, colored, list(views), f"{words.z} ({unit})")
    legend_above(figure, path_keys(truth))
    return figure


def path_keys(truth: Truth | None) -> list[Any]:
    """What the marks of `draw_path` mean."""
    handles = [legend_key(color=INK, lw=1.2, label="cameras"), legend_key(color=WATER, lw=1.0, label="path")]
    if truth is not None:
        handles.append(legend_key(marker="+", ls="", color=SECOND, label="true camera centres"))
        if len(truth.corner):
            handles.append(legend_key(color=OUTLINE, lw=1.5, label="true planes"))
    return handles


def colored_heights(scenes: Sequence[Scene]) -> Any:
    """Colours for the heights of all but stray points of scenes."""
    height = torch.cat([scene.points[:, 2] for scene in scenes])
    low, high = (float(height.quantile(tail)) for tail in TAILS) if len(height) else (0.0, 1.0)
    return plotting.color_scale(low, max(high, low + 1e-9), height_colors())


def draw_path(panel: Any, shown: Scene, truth: Truth | None, frame: Float[Tensor, "3 3"], colored: Any) -> None:
    """Points, path and cameras of a scene, and what is true of them; frame: rows right, up and towards the viewer."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415

    seen = shown.points @ frame.mT
    order = seen[:, 2].argsort()
    right, up, _ = seen[order].numpy().T
    panel.scatter(
        right, up, c=shown.points[order, 2].numpy(), norm=colored.norm, cmap=colored.cmap,
        s=min(max(1.2e4 / max(len(order), 1), 0.8), 6.0), linewidths=0, zorder=2,
    )  # fmt: skip
    for corners in outlines(truth):
        x, y, _ = (corners @ frame.mT).numpy().T
        panel.plot(x, y, "-", color=OUTLINE, lw=1.2, zorder=1)
    centers = shown.views.center[shown.views.registered] @ frame.mT
    panel.plot(*centers[:, :2].numpy().T, "-", color=WATER, lw=1.0, zorder=3)
    lines = (pyramids(shown) @ frame.mT)[..., :2].numpy()
    panel.add_collection(LineCollection(list(lines), colors=INK, linewidths=0.9, zorder=4))
    if truth is not None:
        x, y, _ = (truth.center @ frame.mT).numpy().T
        panel.plot(x, y, "+", ms=6, color=SECOND, zorder=5)
    numbers = (shown.views.registered.nonzero()[:, 0] + 1).tolist()
    for i in {0, len(numbers) - 1}:
        at = (float(centers[i, 0]), float(centers[i, 1]))
        panel.annotate(
            str(numbers[i]), at, (9, 9), textcoords="offset points", fontsize=9, fontweight="bold", color=INK, zorder=6,
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": INK, "linewidth": 0.6, "alpha": 0.9},
            arrowprops={"arrowstyle": "-", "color": INK, "linewidth": 0.6},
        )  # fmt: skip


def pyramids(shown: Scene) -> Float[Tensor, "lines 4 3"]:
    """Four lines for each of the registered cameras: from the centre to two neighbouring corners of the image and back,
    so long that neighbouring cameras just do not touch."""
    camera, centers = shown.views.camera[shown.views.registered], shown.views.center[shown.views.registered]
    around = centers.new_tensor(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)))
    corners = around * centers.new_tensor(shown.cameras.sizes)[camera, None]
    plane = shown.cameras.of_views(camera[:, None]).plane_from_pixels(corners)
    rays = torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1)
    apart = torch.cdist(centers, centers) + torch.diag(centers.new_full((len(centers),), torch.inf))
    extent = float((centers.amax(dim=0) - centers.amin(dim=0)).max())
    nearest = float(apart.amin(dim=-1).median()) if len(centers) > 1 else 1.0
    size = 0.5 * min(max(nearest, 0.08 * extent), 0.3 * max(extent, nearest)) / float(rays.norm(dim=-1).max())
    ends = centers[:, None] + size * rays @ shown.views.rotation[shown.views.registered]
    apex = centers[:, None].expand_as(ends)
    return torch.stack((apex, ends, ends.roll(-1, dims=1), apex), dim=2).flatten(0, 1)


def path_limits(scenes: Sequence[Scene], truth: Truth | None, frame: Float[Tensor, "3 3"]) -> list[list[float]]:
    """Horizontal and vertical range of cameras, true planes, and all but stray points, as `draw_path` draws them."""
    parts = [outlines(truth).flatten(0, 1) @ frame.mT]
    for shown in scenes:
        parts.append(pyramids(shown).flatten(0, 1) @ frame.mT)
        if len(shown.points):
            parts.append((shown.points @ frame.mT).quantile(torch.tensor(TAILS, dtype=torch.float64), dim=0))
    every = torch.cat(parts)[:, :2]
    low, high = every.amin(dim=0), every.amax(dim=0)
    margin = 0.04 * (high - low).max().clamp(min=1e-9)
    return torch.stack((low - margin, high + margin), dim=-1).tolist()
