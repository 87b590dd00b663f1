"""The renderer against an independent one: photographs of the embedded tank, which POV-Ray made.

The textures of the tank are not shipped. They are taken from seven of its photographs, with the true cameras; the
eighth is then rendered with these and compared with what POV-Ray made of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.photographs import read_color
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry.surfaces import Rectangle
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Capture, Truth
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.sight import Scenery, see
from torchrefrac.synthetic.stage import Piece, Stage

COARSE = 2  # pixels; so fine is it known which plane is seen where
MARGIN = 3  # such squares across, around edges of planes, that tell nothing of their colours
REMAP_ROWS = 30_000  # what cv2.remap takes at once
WINDOW = 64  # pixels
LEAST_SHARE = 0.6  # of a window's pixels that must be known
SMOOTHING = 1.0  # pixels, of both images before they are registered


@dataclass(frozen=True)
class Agreement:
    """shifts (k, 2): by how many pixels the photograph is moved against the rendered image, for each of k windows.
    difference: median over the pixels of the absolute difference of a grey value. bias: mean of the difference."""

    shifts: np.ndarray
    difference: float
    bias: float

    @property
    def shift(self) -> float:
        """Median over the windows."""
        return float(np.median(np.linalg.norm(self.shifts, axis=1)))

    @property
    def mean_shift(self) -> np.ndarray:
        """Median over the windows of each coordinate (2): what all have in common."""
        return np.median(self.shifts, axis=0)


class Tank:
    """The embedded tank, its photographs and its true planes."""

    def __init__(self, index_ratio: float | None = None) -> None:
        folder = embedded_scene("tank_small")
        self.capture: Capture = load_capture(folder)
        truth = load_truth(folder)
        assert truth is not None
        self.truth: Truth = truth
        self.index_ratio = self.capture.index_ratio if index_ratio is None else index_ratio
        self.photographs = [read_color(path)[:, :, ::-1].astype(np.float32) for path in self.capture.paths]
        self.rectangles = [Rectangle(*edges) for edges in zip(truth.corner, truth.edge1, truth.edge2, strict=True)]

    @cached_property
    def cameras(self) -> RefractiveCamera:
        lens, truth = self.capture.cameras[0], self.truth
        return RefractiveCamera(lens, truth.rotation, truth.center, FlatInterface(self.index_ratio))

    @cached_property
    def planes_seen(self) -> list[Tensor]:
        """For each photograph the plane that each coarse square sees (rows, columns), -2 near edges."""
        lens, window = self.capture.cameras[0], np.ones((MARGIN, MARGIN))
        grid = lens.pixel_grid(lens.height // COARSE, lens.width // COARSE)
        pieces = [Piece(str(k), rectangle, torch.zeros_like) for k, rectangle in enumerate(self.rectangles)]
        maps = []
        for image in range(len(self.capture)):
            seen = see(pieces, self.cameras[image], grid.flatten(0, 1)).piece
            number = (seen + 1).reshape(grid.shape[:2]).numpy().astype(np.uint8)
            alone = cv2.dilate(number, window) == cv2.erode(number, window)
            maps.append(torch.from_numpy(np.where(alone, number.astype(np.int64) - 1, -2)))
        return maps

    def render(self, image: int, lens: Intrinsics, samples: int) -> np.ndarray:
        """Photograph `image` through `lens` (height, width, 3) in the colours of the others; NaN where none has any."""
        others = [i for i in range(len(self.capture)) if i != image]
        pieces = tuple(Piece(str(k), r, Colours(self, k, others)) for k, r in enumerate(self.rectangles))
        stage = Stage(pieces, self.truth.rotation, self.truth.center, self.truth.length_unit)
        return Photographer(stage, Scenery(pieces, self.index_ratio), lens, samples).take(image).numpy()

    def agreement(
        self, image: int, samples: int, crop: tuple[int, int, int, int] | None = None, moved: Sequence[float] = (0, 0)
    ) -> Agreement:
        """Compare photograph `image`, or its columns and rows crop (left, top, width, height), with the rendered one,
        which is rendered as if the lens had moved the image by `moved` pixels."""
        full = self.capture.cameras[0]
        left, top, width, height = (0, 0, full.width, full.height) if crop is None else crop
        away = full.principal_point.new_tensor((left, top)) - full.principal_point.new_tensor(moved)
        lens = replace(full, width=width, height=height, principal_point=full.principal_point - away)
        part = np.s_[top : top + height, left : left + width]
        photograph = self.photographs[image][part]
        rendered = self.render(image, lens, samples)
        on_plane = self.planes_seen[image].repeat_interleave(COARSE, 0).repeat_interleave(COARSE, 1).numpy() >= 0
        known = np.isfinite(rendered).all(axis=-1) & on_plane[part]
        difference = (rendered - photograph)[known]
        rendered = np.where(known[..., None], rendered, photograph)
        return Agreement(
            shifts=_shifts(rendered, photograph, known),
            difference=float(np.median(np.abs(difference))),
            bias=float(difference.mean()),
        )


@dataclass(frozen=True, eq=False)
class Colours:
    """Colours of a plane of the tank as its photographs `images` show them: their mean, interpolated bicubically."""

    tank: Tank
    plane: int
    images: Sequence[int]

    def __call__(self, uv: Tensor) -> Tensor:
        plane = self.tank.rectangles[self.plane]
        points = plane.corner + uv[:, :1] * plane.edge1 + uv[:, 1:] * plane.edge2
        colours = []
        for image in self.images:
            pixels, seen = self.tank.cameras[image].project(points, inside_image=True)
            rows, columns = self.tank.planes_seen[image].shape
            column, row = (pixels / COARSE).long().unbind(dim=-1)
            column, row = column.clamp(0, columns - 1), row.clamp(0, rows - 1)
            seen = seen & (self.tank.planes_seen[image][row, column] == self.plane)
            places = (pixels - 0.5).float().numpy()
            parts = np.array_split(places, len(places) // REMAP_ROWS + 1)
            sampled = [
                cv2.remap(self.tank.photographs[image], part[:, None], None, cv2.INTER_CUBIC)[:, 0]  # type: ignore[arg-type]
                for part in parts
            ]
            colours.append(torch.where(seen[:, None], torch.from_numpy(np.concatenate(sampled)), torch.nan))
        return torch.stack(colours).nanmean(dim=0)


def _shifts(rendered: np.ndarray, photograph: np.ndarray, known: np.ndarray) -> np.ndarray:
    """One shift and one difference in brightness for each window, by least squares on the images' mean gradient."""
    a, b = (cv2.GaussianBlur(image.mean(axis=-1), (0, 0), SMOOTHING) for image in (rendered, photograph))
    across, down = (cv2.Sobel((a + b) / 2.0, cv2.CV_64F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    shifts = []
    for top in range(0, known.shape[0] - WINDOW + 1, WINDOW):
        for left in range(0, known.shape[1] - WINDOW + 1, WINDOW):
            part = np.s_[top : top + WINDOW, left : left + WINDOW]
            inside = known[part]
            if inside.mean() >= LEAST_SHARE:
                x, y, difference = across[part][inside], down[part][inside], (a - b)[part][inside]
                solution = np.linalg.lstsq(np.stack((x, y, np.ones_like(x)), axis=-1), difference, rcond=None)
                shifts.append(solution[0][:2])
    return np.array(shifts).reshape(-1, 2)
