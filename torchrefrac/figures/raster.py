"""A map of the depth of the surface."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.dense.relief import relief
from torchrefrac.figures.plotting import blank_figure, color_scale, height_colors, save
from torchrefrac.figures.side_views import INK
from torchrefrac.scene.interfaces import SURFACE
from torchrefrac.scene.raster import Raster
from torchrefrac.scene.wording import OF_WATER, Wording

EMPTY = "#e3e1dc"
LONG_SIDE_INCHES, BAR_INCHES, MOST_PIXELS, WIDE = 7.0, 0.18, 1600, 3.0
TAILS = (0.005, 0.995)


def draw_raster(raster: Raster, path: Path, words: Wording = OF_WATER) -> None:
    """Draw the depth of a raster as a shaded map: north up, x and y of the world frame, light from the north-west.

    The colours span all depths but the half per cent at either end; cells without a surface are grey, and a white line
    is the shore, where there is water. Where z = 0 is nothing the map shows z, its colours dark for the lowest. A
    raster of many cells is drawn with every k-th of them.
    """
    from matplotlib.colors import to_rgb  # noqa: PLC0415 - slow to import
    from matplotlib.ticker import FuncFormatter  # noqa: PLC0415

    unit, (rows, columns) = raster.length_unit, raster.height.shape
    step = max(1, math.ceil(max(rows, columns) / MOST_PIXELS))
    depth, valid = raster.depth[::step, ::step].cpu(), raster.valid[::step, ::step].cpu()
    low, high, extend = _range(depth[valid])
    colors = color_scale(low, high, height_colors().reversed())

    size = raster.cell_size
    width, height = max(columns, 1) * size, max(rows, 1) * size
    across, up = (max(side * LONG_SIDE_INCHES / max(width, height), BAR_INCHES) for side in (width, height))
    figure = blank_figure(across, up, None)  # the panel; what stands around it is added when it is saved
    panel = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    if depth.numel():
        lit = torch.from_numpy(colors.to_rgba(depth.numpy())[..., :3]) * relief(depth, valid, step * size)[..., None]
        picture = lit.where(valid[..., None], torch.tensor(to_rgb(EMPTY), dtype=torch.float64))
        right, bottom = raster.x_west + depth.shape[1] * step * size, raster.y_north - depth.shape[0] * step * size
        panel.imshow(picture.numpy(), extent=(raster.x_west, right, bottom, raster.y_north), interpolation="nearest")
    if words.kind == SURFACE and low < 0.0 < high and min(depth.shape) > 1:
        x, y, hidden = raster.x[::step].cpu().numpy(), raster.y[::step].cpu().numpy(), ~valid.numpy()
        panel.contour(x, y, np.ma.masked_array(depth.numpy(), hidden), [0.0], colors="white", linewidths=0.9)
    panel.set(xlim=(raster.x_west, raster.x_west + width), ylim=(raster.y_north - height, raster.y_north))
    panel.set(facecolor=EMPTY, aspect="equal", xlabel=f"x ({unit})", ylabel=f"{words.y} ({unit})")
    panel.tick_params(labelsize=8, color=INK)
    share = float(raster.valid.double().mean()) if raster.valid.numel() else 0.0
    title = words.depth or f"The surface, coloured by {words.z}"
    panel.set_title(f"{title}\n{size:g} {unit} cells, {share:.0%} with a surface", fontsize=10)
    about: dict[str, Any] = {"extend": extend, "label": f"{'depth' if words.depth else words.z} ({unit})"}
    if not words.depth:
        about["format"] = FuncFormatter(lambda value, _: f"{-value:g}")
    if width > WIDE * height:
        beside = figure.add_axes((0.0, -0.85 / up, 1.0, BAR_INCHES / up))
        bar = figure.colorbar(colors, cax=beside, orientation="horizontal", **about)
    else:
        beside = figure.add_axes((1.0 + 0.12 / across, 0.0, BAR_INCHES / across, 1.0))
        bar = figure.colorbar(colors, cax=beside, **about)
        bar.ax.invert_yaxis()
    bar.ax.tick_params(labelsize=8)
    save(figure, path, bbox_inches="tight", pad_inches=0.1)


def _range(depth: Float[Tensor, " n"]) -> tuple[float, float, str]:
    """The depths that the colours span, and at which ends there are others."""
    if not len(depth):
        return 0.0, 1.0, "neither"
    ordered = depth.sort().values
    low, high = (float(ordered[round(part * (len(depth) - 1))]) for part in TAILS)
    beyond = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    extend = beyond[bool(ordered[0] < low), bool(ordered[-1] > high)]
    margin = 0.05 * max(abs(low), 1e-3) if high == low else 0.0
    return low - margin, high + margin, extend
