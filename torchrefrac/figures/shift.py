"""By how many pixels refraction moves what an image sees."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.figures.panels import EMPTY
from torchrefrac.figures.plotting import WIDTH, blank_figure, color_bar, color_scale
from torchrefrac.files.photographs import read_grey
from torchrefrac.geometry import Plane
from torchrefrac.scene import CaptureError, Scene

CELLS, ARROWS = 96, 9  # across the image
FURTHER_DEG = 8.0  # a second image is shown where it looks so much more obliquely


def shift_images(scene: Scene) -> list[int]:
    """The image that looks as obliquely as most do, and the most oblique one where that is another matter."""
    images = scene.views.registered.nonzero()[:, 0]
    tilt = off_nadir(scene)[images]
    order = tilt.argsort()
    typical, most = int(order[(len(order) - 1) // 2]), int(order[-1])
    chosen = [typical] if float(tilt[most] - tilt[typical]) < FURTHER_DEG else [typical, most]
    return [int(images[i]) for i in chosen]


def off_nadir(scene: Scene) -> Float[Tensor, " m"]:
    """Angle in degrees between the optical axes and -z."""
    return (-scene.views.rotation[:, 2, 2]).clamp(-1.0, 1.0).acos().rad2deg()


def typical_depth(scene: Scene) -> float:
    """Median depth of the points below the water; 0 where none is."""
    depth = -scene.points[:, 2]
    below = depth[depth > 0.0]
    return float(below.median()) if len(below) else 0.0


def typical_range(scene: Scene) -> float:
    """Median distance of observed points beyond the ports that they are seen through; 0 where none is."""
    seen = scene.observations[scene.accepted]
    if not len(seen):
        return 0.0
    away = -scene.cameras_of(seen).plane_in_world().signed_distance(scene.points[seen.point])
    return max(float(away.median()), 0.0)


def shift_map(
    scene: Scene, image: int, depth: float
) -> tuple[Float[Tensor, "h w 2"], Float[Tensor, "h w 2"], Bool[Tensor, "h w"]]:
    """Pixels over an image, the shifts of what they see at `depth` beyond the first surface, and whether there are
    any."""
    camera = scene.camera_of(image)
    intrinsics = camera.intrinsics
    columns = min(CELLS, intrinsics.width)
    rows = max(2, round(columns * intrinsics.height / intrinsics.width))
    pixels = intrinsics.pixel_grid(rows, columns).to(torch.float64)
    origins, directions, met = camera.cast_rays(pixels)
    plane = Plane() if scene.interfaces.are_horizontal else camera.plane_in_world()
    fall = torch.where(met, (directions * plane.normal_like(directions)).sum(dim=-1), -1.0)
    points = origins + directions * ((-depth - plane.signed_distance(origins)) / fall)[..., None]
    shift, valid = camera.refraction_shift(points)
    return pixels, shift, valid & met & (fall < 0.0)


def shift_figure(scene: Scene, images: Sequence[int], depth: float, photographs: Sequence[Path]) -> Any:
    """A panel an image: lines of equal shift and arrows of its direction, over the photograph where it is at hand."""
    extents = [scene.cameras.sizes[int(scene.views.camera[image])] for image in images]
    maps = [shift_map(scene, image, depth) for image in images]
    sizes = [shift.norm(dim=-1).where(valid, torch.nan) for _, shift, valid in maps]
    every = torch.cat([size[size.isfinite()] for size in sizes])
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    colored = color_scale(low, max(high, low + 1e-6), "viridis")
    tallest = max(height / width for width, height in extents)
    figure = blank_figure(WIDTH if len(images) > 1 else 6.8, 0.6 + 4.0 * tallest)
    grid = figure.subplots(1, len(images), squeeze=False)[0]
    for panel, image, (width, height), (pixels, shift, valid), size in zip(
        grid, images, extents, maps, sizes, strict=True
    ):
        panel.set(xlim=(0, width), ylim=(height, 0), aspect="equal", facecolor=EMPTY)
        _photograph(panel, photographs[image] if photographs else None, width, height)
        (x, y), moved, here = pixels.numpy().transpose(2, 0, 1), shift.numpy(), valid.numpy()
        panel.imshow(
            size.numpy(), norm=colored.norm, cmap=colored.cmap, alpha=0.5, extent=(0, width, height, 0),
            interpolation="bilinear", zorder=1,
        )  # fmt: skip
        lines = panel.contour(x, y, size.numpy(), levels=7, colors="white", linewidths=1.3, zorder=2)
        panel.clabel(lines, fontsize=9, fmt="%.3g px")
        step = max(1, x.shape[1] // ARROWS)
        some = (slice(step // 2, None, step), slice(step // 2, None, step))
        panel.quiver(
            x[some][here[some]], y[some][here[some]], *moved[some][here[some]].T,
            angles="xy", color="black", width=0.004, pivot="mid", zorder=3,
        )  # fmt: skip
        panel.set_title(f"image {image + 1}: {scene.views.names[image]}", fontsize=10)
        panel.set(xticks=[], yticks=[])
    color_bar(figure, colored, list(grid), "shift (px)")
    return figure


def _photograph(panel: Any, path: Path | None, width: int, height: int) -> None:
    """In grey, behind all else."""
    if path is None or not path.is_file():
        return
    try:
        image = read_grey(path)
    except CaptureError:
        return
    small = cv2.resize(image, (640, max(1, round(640 * height / width))), interpolation=cv2.INTER_AREA)
    panel.imshow(small, cmap="gray", vmin=0, vmax=255, extent=(0, width, height, 0), zorder=0)
