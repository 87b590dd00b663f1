"""Pictures of dense reconstructions: their errors, their shape, and what one image sees of the surface.

As in `figures`, without global state and without a display. Of many points every so-manieth is drawn, so that a panel
has MOST of them at most.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrefrac.geometry import Similarity
from torchrefrac.report.dense_metrics import INLIER_SIGMAS, MAD_TO_SIGMA, signed_plane_distance
from torchrefrac.report.figures import FAINT, INK, PANEL_INCHES, TITLES, WATER, SideView, _across, _corners
from torchrefrac.scene.atomic import replacing
from torchrefrac.scene.dense import DenseCloud, DepthMap
from torchrefrac.scene.truth import Truth

MOST = 150_000
EMPTY = "#d4d4d4"
HEIGHT_COLORS, ERROR_COLORS, DEPTH_COLORS = "jet_r", "RdYlBu", "viridis_r"
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


class _Row(NamedTuple):
    """How one row of a figure looks at the scene: frame (3, 3), rows right, up and towards the viewer; has_cameras and
    the water with them; the labels of its axes, without them a bar shows the scale."""

    frame: Tensor
    labels: tuple[str, str] | None
    has_cameras: bool


def error_panel(
    model: str, cloud: DenseCloud, aligned: Similarity, truth: Truth, metrics: Mapping[str, Any]
) -> ErrorPanel:
    """The panel of a dense cloud; how accurate it is, from the metrics of `evaluate_dense`, stands underneath."""
    unit = truth.length_unit
    points = aligned.apply(_thin(cloud.points))
    start, end = "dense_accuracy_within_", f"_{unit}"
    keys = [key for key in metrics if key.startswith(start) and key.endswith(end)]
    lines = [f"{len(cloud)} points"]
    if keys:
        shares = " / ".join(f"{100.0 * metrics[key]:.1f}" for key in keys)
        limits = " / ".join(key.removeprefix(start).removesuffix(end) for key in keys)
        lines.append(f"{shares} % within {limits} {unit}")
    if f"dense_plane_rms_{unit}" in metrics:
        rms, share = metrics[f"dense_plane_rms_{unit}"], 100.0 * metrics["dense_plane_inliers"]
        lines.append(f"RMS {rms:.3g} {unit} over {share:.1f} % inliers")
    return ErrorPanel(TITLES.get(model, model), "\n".join(lines), points, signed_plane_distance(points, truth)[0], unit)


def draw_error_map(panels: Sequence[ErrorPanel], truth: Truth, path: Path, limit: float | None = None) -> None:
    """Reconstructions side by side, coloured by signed distance to the nearest true plane: red below, blue above.

    Seen from above (x right, y up), and underneath from the side, as `draw_side_views` does. All panels share one scale
    from -limit to limit; without `limit` it is three robust standard deviations of the panel with the smallest errors,
    rounded up to 1, 2 or 5 times a power of ten, so that what the best of them leaves can be seen.
    """
    unit, none = truth.length_unit, torch.zeros(0, 3, dtype=torch.float64)
    columns = [_Column(p.title, p.caption, _thin(p.points), _thin(p.error), none, False) for p in panels]
    scale = _robust_limit([column.values for column in columns]) if limit is None else limit
    rows = (
        _Row(torch.eye(3, dtype=torch.float64), (f"x ({unit})", f"y ({unit})"), False),
        _Row(_from_side(truth), (f"horizontal ({unit})", f"height above the water ({unit})"), False),
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
        _Column(v.title, v.caption, points, points[:, 2], v.centers, v.has_water)
        for v, points in zip(views, shown, strict=True)
    ]
    side = _from_side(truth)
    rows = (
        _Row(_turned(side), None, False),
        _Row(side, (f"horizontal ({unit})", f"height above the water ({unit})"), True),
    )
    known = truth is not None and len(truth.corner) > 0
    low, high = _range(_corners(truth)[..., 2], 1.0) if known else _range(torch.cat(shown)[:, 2], 0.98)
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
    figure = _figure(1.6 + PANEL_INCHES * len(columns), 1.9 + PANEL_INCHES * sum(ratios))
    grid = figure.subplots(
        len(rows), len(columns), sharex="row", sharey="row", squeeze=False, gridspec_kw={"height_ratios": ratios}
    )
    colored = ScalarMappable(Normalize(low, high), name)
    for panels, row, (x, y), ratio in zip(grid, rows, limits, ratios, strict=True):
        for panel, column in zip(panels, columns, strict=True):
            _draw_points(panel, column, row, colored, ratio)
            _draw_surroundings(panel, column, row, truth)
            panel.set(xlim=x, ylim=y, aspect="equal")
            panel.tick_params(labelsize=8)
        
