"""Pictures of dense reconstructions. Of more than MOST points a panel draws every k-th."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.figures.panels import Column, Row, draw_grid, from_side, oblique, outlines
from torchrefrac.figures.side_views import SideView, side_view
from torchrefrac.geometry import Similarity
from torchrefrac.scene import Scene
from torchrefrac.scene.dense import DenseCloud
from torchrefrac.scene.truth import Truth

MOST = 150_000
HEIGHT_COLORS = "jet_r"


def dense_view(
    model: str, cloud: DenseCloud, scene: Scene, aligned: Similarity | None, metrics: Mapping[str, Any]
) -> SideView:
    """The panel of a dense cloud for `draw_dense_views`, with the cameras that it was made from."""
    points = thinned(cloud.points)
    view = side_view(model, scene.with_points(points, thinned(cloud.colors)), aligned, metrics)
    return replace(view, caption=caption_of(len(cloud), metrics, cloud.length_unit))


def draw_dense_views(views: Sequence[SideView], truth: Truth | None, path: Path) -> None:
    """The paper's Figures 1 and 5: reconstructions side by side, coloured by height, red the lowest, blue the highest.

    Seen obliquely from above, and underneath from the side, with cameras and water, as `draw_side_views` does. The true
    planes are drawn as lines. One scale for all panels.
    """
    unit = views[0].length_unit
    shown = [thinned(view.points) for view in views]
    columns = [
        Column(v.title, v.caption, points, points[:, 2], v.centers, v.has_water, unit)
        for v, points in zip(views, shown, strict=True)
    ]
    side = from_side(truth)
    rows = (
        Row(oblique(side), None, False, "white"),
        Row(side, (f"horizontal ({unit})", f"height ({unit})"), True, "white"),
    )
    true_heights = outlines(truth)[..., 2].flatten()
    low, high = range_of(true_heights, 1.0) if len(true_heights) else range_of(torch.cat(shown)[:, 2], 0.98)
    draw_grid(columns, rows, truth, (HEIGHT_COLORS, low, high, f"height ({unit})"), path)


def caption_of(count: int, metrics: Mapping[str, Any], unit: str) -> str:
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


def thinned(rows: Shaped[Tensor, "n *row"]) -> Shaped[Tensor, "m *row"]:
    """Every k-th row, MOST at most."""
    return rows[:: max(1, -(-len(rows) // MOST))]


def range_of(values: Float[Tensor, " n"], share: float) -> tuple[float, float]:
    """The ends of the middle `share` of the values; never equal."""
    if not len(values):
        return 0.0, 1.0
    low, high = np.quantile(values.numpy(), (0.5 - 0.5 * share, 0.5 + 0.5 * share))
    return float(low), float(max(high, low + 1e-6 * max(abs(low), 1.0)))
