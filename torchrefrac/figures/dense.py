"""Pictures of dense reconstructions, of their errors, and of what one view sees of them.

Of more than MOST points a panel draws every k-th.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.evaluate.dense_metrics import INLIER_SIGMAS, MAD_TO_SIGMA, signed_plane_distance, without_outliers
from torchrefrac.figures.panels import (
    EMPTY,
    TO_FRONT_DEG,
    TURN_DEG,
    Column,
    Row,
    draw_grid,
    from_side,
    oblique,
    rounded_up,
)
from torchrefrac.figures.plotting import blank_figure, color_bar, height_colors, save
from torchrefrac.figures.side_views import PANEL_INCHES, TITLES, SideView, outlines, side_view
from torchrefrac.geometry import Similarity
from torchrefrac.scene import DenseCloud, DepthMap, Scene, Truth
from torchrefrac.scene.wording import OF_WATER, Wording

MOST = 150_000
ERROR_COLORS = "RdYlBu"


def dense_view(
    model: str, cloud: DenseCloud, scene: Scene, aligned: Similarity | None, metrics: Mapping[str, Any]
) -> SideView:
    """The panel of a dense cloud for `draw_dense_views`, with the cameras that it was made from."""
    shown = scene.with_points(_thinned(cloud.points), _thinned(cloud.colors))
    view = side_view(model, shown, aligned, metrics)
    return replace(view, caption=_caption(len(cloud), metrics, cloud.length_unit))


def draw_dense_views(views: Sequence[SideView], truth: Truth | None, path: Path) -> None:
    """The paper's Figures 1 and 5: reconstructions side by side, coloured by height, red the lowest, blue the highest.

    Seen obliquely from above, and underneath from the side, with cameras and water, as `draw_side_views` does. The true
    planes are drawn as lines. One scale for all panels.
    """
    unit, words = views[0].length_unit, views[0].words
    side = from_side(truth, words)
    columns = [
        Column(v.title, v.caption, v.points, v.points[:, 2], unit, v.centers, v.has_water, v.words) for v in views
    ]
    rows = (
        Row(oblique(side, TO_FRONT_DEG if words.is_wall else TURN_DEG), None, False, "white"),
        Row(side, (f"{words.across} ({unit})", f"{words.up} ({unit})"), True, "white"),
    )
    true_heights = outlines(truth)[..., 2].flatten()
    low, high = _ends(true_heights, 1.0) if len(true_heights) else _ends(torch.cat([c.values for c in columns]), 0.98)
    draw_grid(columns, rows, truth, (height_colors(), low, high, f"{words.z} ({unit})"), path)


def error_panel(
    model: str,
    cloud: DenseCloud,
    aligned: Similarity,
    truth: Truth,
    metrics: Mapping[str, Any],
    words: Wording = OF_WATER,
) -> Column:
    """The panel of a dense cloud for `draw_error_map`: points in the truth's frame, with their signed distances to the
    true planes; how accurate it is, from the metrics of `evaluate_dense`, stands underneath.

    `aligned` maps the cloud's frame to that of the truth. Raises ValueError where the truth has no planes.
    """
    unit, points = truth.length_unit, aligned.apply(_thinned(cloud.points))
    error, _ = signed_plane_distance(points, truth)
    return Column(TITLES.get(model, model), _caption(len(cloud), metrics, unit), points, error, unit, words=words)


def draw_error_map(panels: Sequence[Column], truth: Truth, path: Path, limit: float | None = None) -> None:
    """Reconstructions side by side, coloured by signed distance to the nearest true plane: red below, blue above.

    Seen along z (x right, y up), and underneath from the side, as `draw_side_views` does. All panels share one scale
    from -limit to limit; without `limit` it is three robust standard deviations of the panel with the smallest errors,
    rounded up to 1, 2 or 5 times a power of ten, so that what the best of them leaves can be seen.
    """
    unit, words = truth.length_unit, panels[0].words
    if limit is None:
        spreads = [MAD_TO_SIGMA * float(panel.values.abs().median()) for panel in panels if len(panel.values)]
        limit = rounded_up(INLIER_SIGMAS * min(spreads, default=0.0))
    rows = (
        Row(torch.eye(3, dtype=torch.float64), (f"x ({unit})", f"{words.y} ({unit})"), False, EMPTY),
        Row(from_side(truth, words), (f"{words.across} ({unit})", f"{words.up} ({unit})"), False, EMPTY),
    )
    draw_grid(panels, rows, truth, (ERROR_COLORS, -limit, limit, f"{words.above} the true plane ({unit})"), path)


def draw_depth_map(depth_map: DepthMap, path: Path, words: Wording = OF_WATER) -> None:
    """What one image sees: the depth along its optical axis, and the height above the water, or what z is else; what is
    deep is dark. Grey where nothing is."""
    valid, unit = depth_map.valid, depth_map.length_unit
    height, width = (size * depth_map.step for size in valid.shape)
    figure = blank_figure(2.0 * PANEL_INCHES + 2.6, 1.1 + PANEL_INCHES * height / width)
    pictures = (
        ("depth", f"depth along the optical axis ({unit})", depth_map.depth, height_colors().reversed()),
        (words.z, f"{words.height} ({unit})", depth_map.points[..., 2], height_colors()),
    )
    for panel, (title, label, values, colors) in zip(figure.subplots(1, 2), pictures, strict=True):
        low, high = _ends(values[valid], 0.98)
        image = panel.imshow(
            np.ma.masked_array(values.numpy(), ~valid.numpy()), cmap=colors.with_extremes(bad=EMPTY),
            vmin=low, vmax=high, extent=(0, width, height, 0), interpolation="nearest",
        )  # fmt: skip
        panel.set_title(title, fontsize=11)
        panel.set_xlabel("x (px)", fontsize=9)
        panel.set_ylabel("y (px)", fontsize=9)
        panel.tick_params(labelsize=8)
        color_bar(figure, image, [panel], label)
    known = f"{100.0 * float(valid.double().mean()):.1f} % of {depth_map.step} x {depth_map.step} pixel cells"
    spread = f", sigma {float(depth_map.sigma[valid].median()):.2g} {unit} (median)" if valid.any() else ""
    figure.suptitle(f"{depth_map.name}: {known}{spread}")
    save(figure, path)


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
        rms = metrics[f"dense_plane_rms_{unit}"]
        lines.append(f"RMS {rms:.3g} {unit}{without_outliers(metrics)}")
    return "\n".join(lines)


def _thinned(rows: Shaped[Tensor, "n *row"]) -> Shaped[Tensor, "m *row"]:
    """Every k-th row, MOST at most."""
    return rows[:: max(1, -(-len(rows) // MOST))]


def _ends(values: Float[Tensor, " n"], share: float) -> tuple[float, float]:
    """The ends of the middle `share` of the values; never equal."""
    if not len(values):
        return 0.0, 1.0
    low, high = np.quantile(values.numpy(), (0.5 - 0.5 * share, 0.5 + 0.5 * share))
    return float(low), float(max(high, low + 1e-6 * max(abs(low), 1.0)))
