"""Pictures of what one view sees of the dense surface."""

from pathlib import Path

import numpy as np

from torchrefrac.atomic import replacing
from torchrefrac.figures.dense import HEIGHT_COLORS, range_of
from torchrefrac.figures.panels import EMPTY
from torchrefrac.figures.plotting import blank_figure, color_bar
from torchrefrac.figures.side_views import PANEL_INCHES
from torchrefrac.scene import DepthMap

DEPTH_COLORS = "viridis_r"


def draw_depth_map(depth_map: DepthMap, path: Path) -> None:
    """What one image sees: the depth along its optical axis, and the height above the water. Grey where nothing is."""
    from matplotlib import colormaps  # noqa: PLC0415 - slow to import

    valid, unit = depth_map.valid, depth_map.length_unit
    height, width = (size * depth_map.step for size in valid.shape)
    figure = blank_figure(2.0 * PANEL_INCHES + 2.6, 1.1 + PANEL_INCHES * height / width)
    pictures = (
        ("depth", f"depth along the optical axis ({unit})", depth_map.depth, DEPTH_COLORS),
        ("height", f"height above the water ({unit})", depth_map.points[..., 2], HEIGHT_COLORS),
    )
    for panel, (title, label, values, colors) in zip(figure.subplots(1, 2), pictures, strict=True):
        low, high = range_of(values[valid], 0.98)
        image = panel.imshow(
            np.ma.masked_array(values.numpy(), ~valid.numpy()), cmap=colormaps[colors].with_extremes(bad=EMPTY),
            vmin=low, vmax=high, extent=(0, width, height, 0), interpolation="nearest",
        )  # fmt: skip
        panel.set_title(title, fontsize=11)
        panel.set_xlabel("x (px)", fontsize=9)
        panel.set_ylabel("y (px)", fontsize=9)
        panel.tick_params(labelsize=8)
        color_bar(figure, image, [panel], label)
    known = f"{100.0 * float(valid.double().mean()):.1f} % of {depth_map.step} x {depth_map.step} pixel cells"
    spread = f", sigma {float(depth_map.sigma[valid].median()):.2g} {unit} (median)" if valid.any() else ""
    figure.suptitle(f"{depth_map.name}: {known}{spread}", fontsize=12)
    with replacing(path) as temporary:
        figure.savefig(temporary)
