"""Pictures of reconstructions. Drawn with matplotlib's object interface: no global state, no display."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.figures.plotting import blank_figure, color_scale, height_colors, legend_above, legend_key, save
from torchrefrac.geometry import Similarity
from torchrefrac.scene import Scene, Truth
from torchrefrac.scene.wording import OF_WATER, Wording, wording_of

TITLES = {
    "none": "No refraction", "radial": "Radial distortion", "bundler": "As Bundler", "refractive": "Refraction",
}  # fmt: skip
MODEL_COLORS = {  # different for the colour-blind too
    "none": "#d55e00", "radial": "#009e73", "bundler": "#cc79a7", "refractive": "#0072b2",
}  # fmt: skip
WATER, INK, FAINT = "#2b7bba", "#222222", "#c4c4c4"
PANEL_INCHES = 4.4


@dataclass(frozen=True)
class SideView:
    """One panel: points and camera centres, moved to those of the truth where there is one."""

    title: str
    caption: str
    points: Float[Tensor, "n 3"]
    centers: Float[Tensor, "m 3"]
    length_unit: str
    has_water: bool
    words: Wording = OF_WATER

    @property
    def surface(self) -> str:
        """What the line at z = 0 is; empty where there is none."""
        return self.words.surface if self.has_water else ""


def side_view(model: str, scene: Scene, aligned: Similarity | None, metrics: Mapping[str, Any]) -> SideView:
    """The panel of a scene, with its camera error (or its number of points) underneath."""
    points, centers = scene.points, scene.views.center[scene.views.registered]
    unit = scene.length_unit
    if aligned is not None:
        points, centers = aligned.apply(points), aligned.apply(centers)
    error = metrics.get(f"camera_rms_{unit}")
    caption = f"{len(points)} points" + (f", camera error {error:.3g} {unit} RMS" if error is not None else "")
    known_frame = aligned is not None or scene.interfaces.stand_in_world
    words = wording_of(scene, metrics, aligned is not None)
    return SideView(TITLES.get(model, model), caption, points, centers, unit, known_frame, words)


def draw_side_views(views: Sequence[SideView], truth: Truth | None, path: Path) -> None:
    """Write the paper's Figure 1, `side_views_figure`, to a file."""
    save(side_views_figure(views, truth), path)


def side_views_figure(views: Sequence[SideView], truth: Truth | None, panel_inches: float = PANEL_INCHES) -> Any:
    """The paper's Figure 1: reconstructions side by side, seen from the side, coloured by height.

    The lowest points are dark, the highest light, on one scale for all panels, which are about `panel_inches` wide; the
    true planes are drawn as lines. The direction of sight is the horizontal one along which the true planes look
    thinnest (without truth: along y). What is seen through a wall has z, before the glass, from left to right, and y
    upwards.
    """
    frame = SideFrame.of(views, truth, height_colors())
    lines = 0.2 * max(view.caption.count("\n") for view in views)
    figure = blank_figure(1.6 + panel_inches * len(views), 1.35 + lines + panel_inches * frame.tall)
    panels = figure.subplots(1, len(views), sharex=True, sharey=True, squeeze=False)[0]
    for panel, view in zip(panels, views, strict=True):
        frame.draw(panel, view)
    frame.explain(figure, list(panels), views)
    return figure


@dataclass(frozen=True)
class SideFrame:
    """What views from the side share: the horizontal direction that runs to the right in them, the ranges of both axes,
    the colours of heights, and the true planes."""

    side: Float[Tensor, " 2"]
    limits: list[tuple[float, float]]
    colored: Any
    truth: Truth | None

    @classmethod
    def of(cls, views: Sequence[SideView], truth: Truth | None, colors: Any) -> "SideFrame":
        """That holds all but stray points of every view; colors: a colour map."""
        side = side_direction(truth)
        return cls(side, _limits(views, truth, side), color_scale(*_height_range(views, truth), colors), truth)

    @property
    def tall(self) -> float:
        """The height of a panel over its width."""
        width, height = (end - start for start, end in self.limits)
        return height / width

    def draw(self, panel: Any, view: SideView) -> None:
        """One view, over the true planes."""
        words, colored = view.words, self.colored
        for corners in outlines(self.truth):
            panel.plot(*_seen(corners, words, self.side), "-", color=FAINT, lw=3.0, zorder=1)
        z = view.points[:, 2].numpy()
        right, up = _seen(view.points, words, self.side)
        panel.scatter(right, up, c=z, s=2.5, cmap=colored.cmap, norm=colored.norm, linewidths=0, zorder=3)
        panel.plot(*_seen(view.centers, words, self.side), "^", ms=5, mfc="none", mec=INK)
        if view.surface:
            draw_first_surface(panel, words)
        panel.set(xlim=self.limits[0], ylim=self.limits[1], aspect="equal")
        panel.set_title(view.title, fontsize=13)
        panel.set_xlabel(f"{words.across} ({view.length_unit})\n{view.caption}")
        panel.tick_params(labelsize=8)

    def explain(self, figure: Any, panels: list[Any], views: Sequence[SideView]) -> None:
        """Say what the upward axis of the first of the panels, the colours and the marks are."""
        words, unit = views[0].words, views[0].length_unit
        panels[0].set_ylabel(f"{words.up if words.is_wall else words.height} ({unit})")
        bar = figure.colorbar(self.colored, ax=panels, pad=0.01, aspect=30, label=f"{words.z} ({unit})")
        bar.ax.tick_params(labelsize=8)
        handles = camera_keys(next((view.surface for view in views if view.surface), ""))
        if len(outlines(self.truth)):
            handles.append(legend_key(color=FAINT, lw=3, label="true planes"))
        legend_above(figure, handles)


def camera_keys(surface: str) -> list[Any]:
    """What the marks of cameras mean, and of the first surface, by what it is called."""
    cameras = legend_key(marker="^", ls="", mfc="none", mec=INK, label="cameras")
    return [cameras, legend_key(color=WATER, label=surface)] if surface else [cameras]


def draw_first_surface(panel: Any, words: Wording) -> None:
    """The plane z = 0 in a view from the side."""
    line = panel.axvline if words.is_wall else panel.axhline
    line(0.0, color=WATER, lw=1.2, zorder=2)


def _seen(points: Float[Tensor, "n 3"], words: Wording, side: Float[Tensor, " 2"]) -> tuple[Any, Any]:
    """What of points runs to the right and upwards in a view from the side, as arrays."""
    z = points[:, 2].numpy()
    return (z, points[:, 1].numpy()) if words.is_wall else ((points[:, :2] @ side).numpy(), z)


def side_direction(truth: Truth | None) -> Float[Tensor, " 2"]:
    """Unit horizontal direction that runs from left to right in the picture."""
    if truth is None or not len(truth.corner):
        return torch.tensor((1.0, 0.0), dtype=torch.float64)
    normal = truth.normal[:, :2]
    _, vectors = torch.linalg.eigh(normal.T @ normal)
    across = vectors[:, 1]
    return across * torch.sign(across[across.abs().argmax()])


def _height_range(views: Sequence[SideView], truth: Truth | None) -> tuple[float, float]:
    corners = outlines(truth)[..., 2]
    if len(corners):
        return float(corners.min()), float(corners.max())
    heights = torch.cat([view.points[:, 2] for view in views])
    return (float(heights.quantile(0.01)), float(heights.quantile(0.99))) if len(heights) else (-1.0, 0.0)


def outlines(truth: Truth | None) -> Float[Tensor, "k 5 3"]:
    """Closed outlines of the true planes."""
    if truth is None:
        return torch.zeros(0, 5, 3, dtype=torch.float64)
    a, b, c = truth.corner, truth.edge1, truth.edge2
    return torch.stack((a, a + b, a + b + c, a + c, a), dim=1)


def true_of(values: Float[Tensor, "m *row"], truth: Truth, names: Sequence[str]) -> Float[Tensor, "k *row"]:
    """The rows of the images `names` in values of the truth's images; NaN where the truth lacks an image."""
    found = values.new_full((len(names), *values.shape[1:]), torch.nan)
    for row, name in enumerate(names):
        if name in truth.names:
            found[row] = values[truth.names.index(name)]
    return found


def _limits(views: Sequence[SideView], truth: Truth | None, side: Float[Tensor, " 2"]) -> list[tuple[float, float]]:
    """Horizontal and vertical range: cameras, true planes, and all but the most stray points of every panel."""
    shown = [outlines(truth).flatten(0, 1), *(view.centers for view in views)]
    for view in views:
        if len(view.points):
            shown.append(view.points.quantile(torch.tensor((0.01, 0.99), dtype=view.points.dtype), dim=0))
    if views[0].words.surface or not any(map(len, shown)):
        shown.append(torch.zeros(1, 3, dtype=torch.float64))
    limits = []
    for values in _seen(torch.cat(shown), views[0].words, side):
        low, high = float(values.min()), float(values.max())
        margin = 0.06 * max(high - low, 1e-6)
        limits.append((low - margin, high + margin))
    return limits
