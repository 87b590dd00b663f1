"""Pictures of dense reconstructions: their errors, their shape, and what one image sees of the surface.

As in `figures`, without global state and without a display. Of more than MOST points a panel draws every k-th.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefrac.geometry import Similarity
from torchrefrac.report.dense_metrics import INLIER_SIGMAS, MAD_TO_SIGMA, signed_plane_distance
from torchrefrac.report.figures import INK, PANEL_INCHES, TITLES, WATER, SideView, _across, _corners, side_view
from torchrefrac.scene.atomic import replacing
from torchrefrac.scene.dense import DenseCloud, DepthMap
from torchrefrac.scene.reconstruction import Reconstruction
from torchrefrac.scene.truth import Truth

MOST = 150_000
EMPTY, OUTLINE = "#d4d4d4", "#8c8c8c"
HEIGHT_COLORS, ERROR_COLORS, DEPTH_COLORS = "jet_r", "RdYlBu", "viridis_r"
GOLDEN = 0.6180339887498949  # its multiples fill the interval from 0 to 1 evenly, modulo 1
SLIMMEST = 0.2  # a panel, its shorter side over its longer one
TURN_DEG, RISE_DEG = 30.0, 28.0  # from where an oblique view looks: turned from the side, and raised


@dataclass(frozen=True)
class ErrorPanel:
    """One panel: points (n, 3) in the truth's frame, with their signed distances (n) to the true planes."""

    title: str
    caption: str
    points: Tensor
    error: Tensor
    length_unit: str


class _Column(NamedTuple):
    """What both rows of a figure show of one reconstruction; values (n) give the points (n, 3) their colour."""

    title: str
    caption: str
    points: Tensor
    values: Tensor
    centers: Tensor
    has_water: bool
    unit: str


class _Row(NamedTuple):
    """How one row of a figure looks at the scene.

    frame (3, 3): rows right, up and towards the viewer; labels: of the axes, without them a bar shows the scale;
    has_cameras: whether cameras and water are drawn; paper: colour behind the points.
    """

    frame: Tensor
    labels: tuple[str, str] | None
    has_cameras: bool
    paper: str


def error_panel(
    model: str, cloud: DenseCloud, aligned: Similarity, truth: Truth, metrics: Mapping[str, Any]
) -> ErrorPanel:
    """The panel of a dense cloud; how accurate it is, from the metrics of `evaluate_dense`, stands underneath.

    `aligned` maps the cloud's frame to that of the truth. Raises ValueError where the truth has no planes.
    """
    unit = truth.length_unit
    points = aligned.apply(_thin(cloud.points))
    error, _ = signed_plane_distance(points, truth)
    return ErrorPanel(TITLES.get(model, model), _caption(len(cloud), metrics, unit), points, error, unit)


def dense_view(
    model: str,
    cloud: DenseCloud,
    reconstruction: Reconstruction,
    aligned: Similarity | None,
    metrics: Mapping[str, Any],
) -> SideView:
    """The panel of a dense cloud for `draw_dense_views`, with the cameras that it was made from."""
    points = _thin(cloud.points)
    view = side_view(model, replace(reconstruction, points=points), aligned, metrics)
    return replace(view, caption=_caption(len(cloud), metrics, cloud.length_unit))


def draw_error_map(panels: Sequence[ErrorPanel], truth: Truth, path: Path, limit: float | None = None) -> None:
    """Reconstructions side by side, coloured by signed distance to the nearest true plane: red below, blue above.

    Seen from above (x right, y up), and underneath from the side, as `draw_side_views` does. All panels share one scale
    from -limit to limit; without `limit` it is three robust standard deviations of the panel with the smallest errors,
    rounded up to 1, 2 or 5 times a power of ten, so that what the best of them leaves can be seen.
    """
    unit, none = truth.length_unit, torch.zeros(0, 3, dtype=torch.float64)
    columns = [_Column(p.title, p.caption, _thin(p.points), _thin(p.error), none, False, unit) for p in panels]
    scale = _robust_limit([column.values for column in columns]) if limit is None else limit
    rows = (
        _Row(torch.eye(3, dtype=torch.float64), (f"x ({unit})", f"y ({unit})"), False, EMPTY),
        _Row(_from_side(truth), (f"horizontal ({unit})", f"height ({unit})"), False, EMPTY),
    )
    _draw(columns, rows, truth, (ERROR_COLORS, -scale, scale, f"above the true plane ({unit})"), path)


def draw_dense_views(views: Sequence[SideView], truth: Truth | None, path: Path) -> None:
    """The paper's Figures 1 and 5: reconstructions side by side, coloured by height, red the lowest, blue the highest.

    Seen obliquely from above, and underneath from the side, with cameras and water, as `draw_side_views` does. The true
    planes are drawn as lines. One scale for all panels.
    """
    unit = views[0].length_unit
    shown = [_thin(view.points) for view in views]
    columns = [
        _Column(v.title, v.caption, points, points[:, 2], v.centers, v.has_water, unit)
        for v, points in zip(views, shown, strict=True)
    ]
    side = _from_side(truth)
    rows = (
        _Row(_turned(side), None, False, "white"),
        _Row(side, (f"horizontal ({unit})", f"height ({unit})"), True, "white"),
    )
    true_heights = _outlines(truth)[..., 2].flatten()
    low, high = _range(true_heights, 1.0) if len(true_heights) else _range(torch.cat(shown)[:, 2], 0.98)
    _draw(columns, rows, truth, (HEIGHT_COLORS, low, high, f"height ({unit})"), path)


def draw_depth_map(depth_map: DepthMap, path: Path) -> None:
    """What one image sees: the depth along its optical axis, and the height above the water. Grey where nothing is."""
    from matplotlib import colormaps  # noqa: PLC0415 - slow to import

    valid, unit = depth_map.valid, depth_map.length_unit
    height, width = (size * depth_map.step for size in valid.shape)
    figure = _figure(2.0 * PANEL_INCHES + 2.6, 1.1 + PANEL_INCHES * height / width)
    pictures = (
        ("depth", f"depth along the optical axis ({unit})", depth_map.depth, DEPTH_COLORS),
        ("height", f"height above the water ({unit})", depth_map.points[..., 2], HEIGHT_COLORS),
    )
    for panel, (title, label, values, colors) in zip(figure.subplots(1, 2), pictures, strict=True):
        low, high = _range(values[valid], 0.98)
        image = panel.imshow(
            np.ma.masked_array(values.numpy(), ~valid.numpy()), cmap=colormaps[colors].with_extremes(bad=EMPTY),
            vmin=low, vmax=high, extent=(0, width, height, 0), interpolation="nearest",
        )  # fmt: skip
        panel.set_title(title, fontsize=11)
        panel.set_xlabel("x (px)", fontsize=9)
        panel.set_ylabel("y (px)", fontsize=9)
        panel.tick_params(labelsize=8)
        _color_bar(figure, image, [panel], label)
    known = f"{100.0 * float(valid.double().mean()):.1f} % of {depth_map.step} x {depth_map.step} pixel cells"
    spread = f", sigma {float(depth_map.sigma[valid].median()):.2g} {unit} (median)" if valid.any() else ""
    figure.suptitle(f"{depth_map.name}: {known}{spread}", fontsize=12)
    with replacing(path) as temporary:
        figure.savefig(temporary)


def _caption(count: int, metrics: Mapping[str, Any], unit: str) -> str:
    """How many points there are, and how accurate they are where the metrics of `evaluate_dense` say so."""
    start, end = "dense_accuracy_within_", f"_{unit}"
    keys = [key for key in metrics if key.startswith(start) and key.endswith(end)]
    lines = [f"{count} points"]
    if keys:
        shares = " / ".join(f"{100.0 * metrics[key]:.1f}" for key in keys)
        limits = " / ".join(key.removeprefix(start).removesuffix(end) for key in keys)
        lines.append(f"{shares} % within {limits} {unit}")
    if f"dense_plane_rms_{unit}" in metrics:
        rms, share = metrics[f"dense_plane_rms_{unit}"], 100.0 * metrics["dense_plane_inliers"]
        lines.append(f"RMS {rms:.3g} {unit} over {share:.1f} % inliers")
    return "\n".join(lines)


def _draw(
    columns: Sequence[_Column],
    rows: Sequence[_Row],
    truth: Truth | None,
    colors: tuple[str, float, float, str],
    path: Path,
) -> None:
    """A grid of panels, a column a reconstruction, and a row a way to look at it; colours: map, ends, label."""
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415 - slow to import
    from matplotlib.colors import Normalize  # noqa: PLC0415

    name, low, high, label = colors
    limits = [_limits(columns, row, truth) for row in rows]
    ratios = [(y[1] - y[0]) / (x[1] - x[0]) for x, y in limits]
    lines = max(column.caption.count("\n") for column in columns) + 2
    labels = 0.55 * sum(row.labels is not None for row in rows) + 0.16 * lines
    figure = _figure(1.6 + PANEL_INCHES * len(columns), 0.75 + labels + PANEL_INCHES * sum(ratios))
    grid = figure.subplots(
        len(rows), len(columns), sharex="row", sharey="row", squeeze=False, gridspec_kw={"height_ratios": ratios}
    )
    colored = ScalarMappable(Normalize(low, high), name)
    for panels, row, (x, y) in zip(grid, rows, limits, strict=True):
        for panel, column in zip(panels, columns, strict=True):
            _draw_points(panel, column, row, colored, blur=0.01 * (x[1] - x[0]))
            _draw_surroundings(panel, column, row, truth)
            panel.set(xlim=x, ylim=y, aspect="equal", facecolor=row.paper)
            panel.tick_params(labelsize=8)
            if row.labels is None:
                _scale_bar(panel, x, y, columns[0].unit)
            else:
                panel.set_xlabel(row.labels[0], fontsize=10)
        if row.labels is not None:
            panels[0].set_ylabel(row.labels[1], fontsize=10)
    for top, bottom, column in zip(grid[0], grid[-1], columns, strict=True):
        top.set_title(column.title, fontsize=13)
        bottom.set_xlabel(f"{bottom.get_xlabel()}\n{column.caption}", fontsize=10)
    _color_bar(figure, colored, list(grid.flat), label)
    _legend(figure, columns, rows, truth)
    with replacing(path) as temporary:
        figure.savefig(temporary)


def _draw_points(panel: Any, column: _Column, row: _Row, colored: Any, blur: float) -> None:
    """The farthest first, so that near ones hide them; each about as large as its share of the panel.

    Far within `blur` of each other their order is arbitrary: else, from above, the highest of a surface would win.
    """
    right, up, near = (column.points @ row.frame.mT).unbind(dim=-1)
    order = (near + blur * (GOLDEN * torch.arange(len(near), dtype=near.dtype)).frac()).argsort()
    size = min(max(2.5e5 / max(len(order), 1), 1.5), 7.0)
    panel.scatter(
        right[order].numpy(), up[order].numpy(), c=column.values[order].numpy(), norm=colored.norm, cmap=colored.cmap,
        s=size, linewidths=0, antialiased=False, rasterized=True, zorder=3,
    )  # fmt: skip


def _draw_surroundings(panel: Any, column: _Column, row: _Row, truth: Truth | None) -> None:
    """The outlines of the true planes, and the cameras and the water where the row has them."""
    for corners in _outlines(truth):
        right, up, _ = (corners @ row.frame.mT).unbind(dim=-1)
        panel.plot(right.numpy(), up.numpy(), "-", color=OUTLINE, lw=1.5, zorder=1)
    if row.has_cameras:
        right, up, _ = (column.centers @ row.frame.mT).unbind(dim=-1)
        panel.plot(right.numpy(), up.numpy(), "^", ms=5, mfc="none", mec=INK, zorder=4)
        if column.has_water:
            panel.axhline(0.0, color=WATER, lw=1.2, zorder=2)


def _scale_bar(panel: Any, x: tuple[float, float], y: tuple[float, float], unit: str) -> None:
    """In place of axes, as an oblique view has none: a length that holds for whatever lies across the view."""
    width, height = x[1] - x[0], y[1] - y[0]
    length = _rounded_up(0.1 * width)
    start, level = x[0] + 0.04 * width, y[0] + 0.05 * height
    panel.plot((start, start + length), (level, level), "-", color=INK, lw=2.0, zorder=5)
    panel.text(start + 0.5 * length, level + 0.015 * height, f"{length:g} {unit}", ha="center", va="bottom", fontsize=9)
    panel.set_xticks([])
    panel.set_yticks([])


def _legend(figure: Any, columns: Sequence[_Column], rows: Sequence[_Row], truth: Truth | None) -> None:
    from matplotlib.lines import Line2D  # noqa: PLC0415 - slow to import

    handles = []
    if any(row.has_cameras for row in rows):
        handles.append(Line2D([], [], marker="^", ls="", mfc="none", mec=INK, label="cameras"))
        if any(column.has_water for column in columns):
            handles.append(Line2D([], [], color=WATER, label="water surface"))
    if len(_outlines(truth)):
        handles.append(Line2D([], [], color=OUTLINE, lw=1.5, label="true planes"))
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=9, frameon=False)


def _color_bar(figure: Any, colored: Any, panels: list[Any], label: str) -> None:
    bar = figure.colorbar(colored, ax=panels, pad=0.01, aspect=30, fraction=0.15 / len(panels), extend="both")
    bar.set_label(label, fontsize=10)
    bar.ax.tick_params(labelsize=8)


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - slow to import
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(width, height), dpi=150)
    figure.set_layout_engine("constrained")
    FigureCanvasAgg(figure)
    return figure


def _from_side(truth: Truth | None) -> Tensor:
    """Frame (3, 3) that looks along the horizontal direction in which the true planes are thinnest."""
    x, y = _across(truth).tolist()
    return torch.tensor(((x, y, 0.0), (0.0, 0.0, 1.0), (y, -x, 0.0)), dtype=torch.float64)


def _turned(side: Tensor) -> Tensor:
    """The frame of an oblique view: that from the side, turned about the vertical and raised."""
    turn, rise = math.radians(TURN_DEG), math.radians(RISE_DEG)
    right = math.cos(turn) * side[0] + math.sin(turn) * side[2]
    level = math.cos(turn) * side[2] - math.sin(turn) * side[0]
    return torch.stack(
        (right, math.cos(rise) * side[1] - math.sin(rise) * level, math.sin(rise) * side[1] + math.cos(rise) * level)
    )


def _limits(
    columns: Sequence[_Column], row: _Row, truth: Truth | None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Horizontal and vertical range of a row: true planes, all but stray points, and what else the row has."""
    shown = [_outlines(truth).flatten(0, 1) @ row.frame.mT]
    for column in columns:
        points = column.points @ row.frame.mT
        if len(points):
            shown.append(points.quantile(torch.tensor((0.001, 0.999), dtype=points.dtype), dim=0))
        if row.has_cameras:
            shown += [column.centers @ row.frame.mT, torch.zeros(1, 3, dtype=torch.float64)]
    every = torch.cat(shown)[:, :2]
    every = every if len(every) else torch.zeros(1, 2, dtype=torch.float64)
    low, high = every.amin(dim=0), every.amax(dim=0)
    half = 0.56 * (high - low)
    half = half.clamp(min=SLIMMEST * float(half.max())) if half.max() > 0.0 else torch.ones_like(half)
    ends = torch.stack((0.5 * (low + high) - half, 0.5 * (low + high) + half), dim=-1).tolist()
    return (ends[0][0], ends[0][1]), (ends[1][0], ends[1][1])


def _outlines(truth: Truth | None) -> Tensor:
    """Closed outlines (k, 5, 3) of the true planes."""
    if truth is None or not len(truth.corner):
        return torch.zeros(0, 5, 3, dtype=torch.float64)
    return _corners(truth)[:, (0, 1, 2, 3, 0)]


def _thin(rows: Tensor) -> Tensor:
    """Every k-th row, MOST at most."""
    return rows[:: max(1, -(-len(rows) // MOST))]


def _range(values: Tensor, share: float) -> tuple[float, float]:
    """The ends of the middle `share` of the values; never equal."""
    if not len(values):
        return 0.0, 1.0
    low, high = np.quantile(values.numpy(), (0.5 - 0.5 * share, 0.5 + 0.5 * share))
    return float(low), float(max(high, low + 1e-6 * max(abs(low), 1.0)))


def _robust_limit(errors: Sequence[Tensor]) -> float:
    """Of the panel with the smallest errors."""
    spreads = [MAD_TO_SIGMA * float(values.abs().median()) for values in errors if len(values)]
    return _rounded_up(INLIER_SIGMAS * min(spreads, default=0.0))


def _rounded_up(value: float) -> float:
    """1, 2, 5 or 10 times a power of ten; 1 for 0."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power * (1.0 + 1e-9))
