"""Pictures of reconstructions. Drawn with matplotlib's object interface: no global state, no display."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrefrac.geometry import Similarity
from torchrefrac.scene import Reconstruction, Truth
from torchrefrac.scene.atomic import replacing

TITLES = {"none": "No refraction", "radial": "Radial distortion", "refractive": "Refraction"}
WATER, INK, FAINT = "#2b7bba", "#222222", "#8a8a8a"


@dataclass(frozen=True)
class SideView:
    """One panel: points (n, 3) and camera centres (m, 3), aligned to truth where there is one."""

    title: str
    caption: str
    points: Tensor
    centers: Tensor
    length_unit: str
    has_water: bool


def side_view(
    model: str, reconstruction: Reconstruction, aligned: Similarity | None, metrics: Mapping[str, Any]
) -> SideView:
    """The panel of a reconstruction, with its camera error (or its number of points) underneath."""
    points, centers = reconstruction.points, reconstruction.center[reconstruction.registered]
    unit = reconstruction.length_unit
    if aligned is not None:
        points, centers = aligned.apply(points), aligned.apply(centers)
    error = metrics.get(f"camera_rms_{unit}")
    caption = f"{len(points)} points" + (f", camera error {error:.3g} {unit} RMS" if error is not None else "")
    known_frame = aligned is not None or reconstruction.index_ratio > 1.0
    return SideView(TITLES.get(model, model), caption, points, centers, unit, known_frame)


def draw_side_views(views: Sequence[SideView], truth: Truth | None, path: Path) -> None:
    """The paper's Figure 1: reconstructions side by side, seen from the side, coloured by height.

    Red is the lowest point, blue the highest, on one scale for all panels; the true planes are drawn as lines. The
    direction of sight is the horizontal one along which the true planes look thinnest (without truth: along y).
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - slow to import
    from matplotlib.figure import Figure  # noqa: PLC0415

    across = _across(truth)
    low, high = _height_range(views, truth)
    figure = Figure(figsize=(0.6 + 4.6 * len(views), 4.2), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(views), sharex=truth is not None, sharey=truth is not None, squeeze=False)[0]
    scatter = None
    for panel, view in zip(panels, views, strict=True):
        horizontal = (view.points[:, :2] @ across).numpy()
        height = view.points[:, 2].numpy()
        scatter = panel.scatter(
            horizontal, height, c=height, s=2.0, cmap="jet_r", vmin=low, vmax=high, linewidths=0, rasterized=True
        )
        panel.plot((view.centers[:, :2] @ across).numpy(), view.centers[:, 2].numpy(), "^", ms=5, mfc="none", mec=INK)
        if view.has_water:
            panel.axhline(0.0, color=WATER, lw=1.2)
            panel.annotate(
                "water surface", (0.99, 0.0), (0, 3), xycoords=("axes fraction", "data"),
                textcoords="offset points", ha="right", color=WATER, fontsize=8,
            )  # fmt: skip
        if truth is not None:
            _draw_planes(panel, truth, across)
        panel.set_title(view.title, fontsize=12)
        panel.set_xlabel(f"{view.caption}\nhorizontal ({view.length_unit})", fontsize=9)
        panel.set_aspect("equal", adjustable="box" if truth is not None else "datalim")
        panel.tick_params(labelsize=8)
    panels[0].set_ylabel(f"height above the water ({views[0].length_unit})", fontsize=9)
    if truth is not None:
        _limit(panels[0], truth, across)
        panels[0].plot([], [], "-", color=INK, lw=1.0, label="true planes")
    panels[0].plot([], [], "^", ms=5, mfc="none", mec=INK, label="cameras")
    panels[0].legend(loc="lower left", fontsize=8, frameon=True, framealpha=0.85, edgecolor="none")
    if scatter is not None:
        bar = figure.colorbar(scatter, ax=list(panels), shrink=0.8, pad=0.01)
        bar.set_label(f"height ({views[0].length_unit})", fontsize=9)
        bar.ax.tick_params(labelsize=8)
    with replacing(path) as temporary:
        figure.savefig(temporary)


def _across(truth: Truth | None) -> Tensor:
    """Unit horizontal direction (2) that runs from left to right in the picture."""
    if truth is None or not len(truth.corner):
        return torch.tensor((1.0, 0.0), dtype=torch.float64)
    normal = truth.normal[:, :2]
    _, vectors = torch.linalg.eigh(normal.T @ normal)
    across = vectors[:, 1]
    return across * torch.sign(across[across.abs().argmax()])


def _height_range(views: Sequence[SideView], truth: Truth | None) -> tuple[float, float]:
    if truth is not None and len(truth.corner):
        corners = _corners(truth)[..., 2]
        return float(corners.min()), float(corners.max())
    heights = torch.cat([view.points[:, 2] for view in views])
    if not len(heights):
        return -1.0, 0.0
    return float(heights.quantile(0.01)), float(heights.quantile(0.99))


def _corners(truth: Truth) -> Tensor:
    """(k, 4, 3)."""
    a, b, c = truth.corner, truth.edge1, truth.edge2
    return torch.stack((a, a + b, a + b + c, a + c), dim=1)


def _draw_planes(panel: Any, truth: Truth, across: Tensor) -> None:
    for corners in _corners(truth):
        closed = torch.cat((corners, corners[:1]))
        panel.plot((closed[:, :2] @ across).numpy(), closed[:, 2].numpy(), "-", color=INK, lw=1.0)


def _limit(panel: Any, truth: Truth, across: Tensor) -> None:
    """Show the true scene and cameras with a margin, whatever strays."""
    corners = _corners(truth).flatten(0, 1)
    horizontal = torch.cat((corners[:, :2], truth.center[:, :2])) @ across
    vertical = torch.cat((corners[:, 2], truth.center[:, 2]))
    for values, limit in ((horizontal, panel.set_xlim), (vertical, panel.set_ylim)):
        margin = 0.08 * float(values.max() - values.min())
        limit(*np.array((float(values.min()) - margin, float(values.max()) + margin)))
