"""Pictures of the errors of dense reconstructions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.evaluate.dense_metrics import INLIER_SIGMAS, MAD_TO_SIGMA, signed_plane_distance
from torchrefrac.figures.dense import caption_of, thinned
from torchrefrac.figures.panels import EMPTY, Column, Row, draw_grid, from_side, rounded_up
from torchrefrac.figures.side_views import TITLES
from torchrefrac.geometry import Similarity
from torchrefrac.scene import DenseCloud, Truth

ERROR_COLORS = "RdYlBu"


@dataclass(frozen=True)
class ErrorPanel:
    """One panel: points in the truth's frame, with their signed distances to the true planes."""

    title: str
    caption: str
    points: Float[Tensor, "n 3"]
    error: Float[Tensor, " n"]
    length_unit: str


def error_panel(
    model: str, cloud: DenseCloud, aligned: Similarity, truth: Truth, metrics: Mapping[str, Any]
) -> ErrorPanel:
    """The panel of a dense cloud; how accurate it is, from the metrics of `evaluate_dense`, stands underneath.

    `aligned` maps the cloud's frame to that of the truth. Raises ValueError where the truth has no planes.
    """
    unit = truth.length_unit
    points = aligned.apply(thinned(cloud.points))
    error, _ = signed_plane_distance(points, truth)
    return ErrorPanel(TITLES.get(model, model), caption_of(len(cloud), metrics, unit), points, error, unit)


def draw_error_map(panels: Sequence[ErrorPanel], truth: Truth, path: Path, limit: float | None = None) -> None:
    """Reconstructions side by side, coloured by signed distance to the nearest true plane: red below, blue above.

    Seen from above (x right, y up), and underneath from the side, as `draw_side_views` does. All panels share one scale
    from -limit to limit; without `limit` it is three robust standard deviations of the panel with the smallest errors,
    rounded up to 1, 2 or 5 times a power of ten, so that what the best of them leaves can be seen.
    """
    unit, none = truth.length_unit, torch.zeros(0, 3, dtype=torch.float64)
    columns = [Column(p.title, p.caption, thinned(p.points), thinned(p.error), none, False, unit) for p in panels]
    scale = _robust_limit([column.values for column in columns]) if limit is None else limit
    rows = (
        Row(torch.eye(3, dtype=torch.float64), (f"x ({unit})", f"y ({unit})"), False, EMPTY),
        Row(from_side(truth), (f"horizontal ({unit})", f"height ({unit})"), False, EMPTY),
    )
    draw_grid(columns, rows, truth, (ERROR_COLORS, -scale, scale, f"above the true plane ({unit})"), path)


def _robust_limit(errors: Sequence[Float[Tensor, "_"]]) -> float:
    """Of the panel with the smallest errors."""
    spreads = [MAD_TO_SIGMA * float(values.abs().median()) for values in errors if len(values)]
    return rounded_up(INLIER_SIGMAS * min(spreads, default=0.0))
