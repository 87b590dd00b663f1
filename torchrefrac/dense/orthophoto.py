"""The surface in colour as seen from straight above, with the refraction taken out."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.images import Images
from torchrefrac.dense.rays import depth_in
from torchrefrac.files.photographs import read_color
from torchrefrac.numerics import counted_in_runs, thin
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Raster, Scene

FINEST = 8  # cells of the orthophoto along one of the surface, at most
EDGE = 0.1  # share of the width of a photograph, from its border, over which its weight falls to nothing
BLOCK = 500_000  # cells that are looked at together
SAMPLED, ROUNDS = 100_000, 5  # cells by which exposures are compared, and how often
Z_CELL, Z_TOLERANCE = 4, 3.0  # pixels of a cell in which the nearest surface hides others; cells of the surface


def orthophoto(
    surface: Raster, scene: Scene, images: Images, recorder: Recorder | None = None, fine: bool = True
) -> Raster:
    """The raster with the colours that photographs have where its cells are seen through the water; and finer by the
    factor (8 at most) at which a cell is as wide as a pixel reaches.

    A cell is seen by a view in whose photograph it lies, on a pixel that may be used, and which nothing else of the
    surface hides. Of several views the mean is taken, weighted by the cosine of the viewing angle to the fourth, so
    that the most vertical ray prevails, and less towards the borders of photographs, so that no seam is seen. Exposures
    are made equal before: each colour of each photograph is multiplied by what brings it to the mean of all.

    surface: in the frame of the scene. Cells that no view shows keep the colour that they have.
    """
    recorder = recorder or SilentRecorder()
    views = scene.views.registered.nonzero()[:, 0].tolist()
    fine_surface = _finer(surface, _factor(surface, scene) if fine else 1)
    cells, coarse = _Cells.of(fine_surface), _Cells.of(surface)
    solid = torch.cat((coarse.points, _sides(surface)))
    hiding = {view: _hiding(solid, surface.cell_size, scene.camera_of(view)) for view in views}
    gains = _gains(coarse, scene, images, hiding)
    total = torch.zeros(len(cells.points), 4, dtype=torch.float32)
    for view in recorder.track(views, len(views), "orthophoto", "image"):
        colors, weight = _seen(cells, scene.camera_of(view), view, images, hiding[view])
        total[:, :3] += weight[:, None] * colors * gains[view]
        total[:, 3] += weight
    seen = total[:, 3] > 0.0
    mean = (total[:, :3] / total[:, 3:].clamp(min=1e-12)).round().clamp(0.0, 255.0).to(torch.uint8)
    colors = fine_surface.colors.clone()
    colors[cells.row[seen], cells.column[seen]] = mean[seen]
    return replace(fine_surface, colors=colors)


@dataclass(frozen=True)
class _Cells:
    """The cells of a raster that have a surface: where they are in it, their middles in the world, and their side."""

    row: Int[Tensor, " n"]
    column: Int[Tensor, " n"]
    points: Float[Tensor, "n 3"]
    size: float

    @classmethod
    def of(cls, raster: Raster) -> "_Cells":
        row, column = raster.valid.nonzero().unbind(dim=-1)
        points = torch.stack((raster.x[column], raster.y[row], raster.height[row, column]), dim=-1)
        return cls(row, column, points, raster.cell_size)

    def sampled(self, count: int) -> "_Cells":
        """So many of them at most."""
        rows = thin(torch.arange(len(self.row)), count)
        return replace(self, row=self.row[rows], column=self.column[rows], points=self.points[rows])


@dataclass(frozen=True)
class _Hiding:
    """How far from a camera the nearest surface is, in cells of Z_CELL pixels; and how much farther is no other."""

    depth: Float[Tensor, "rows columns"]
    tolerance: float

    def shows(self, pixels: Float[Tensor, "n 2"], depth: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
        column, row = (pixels / Z_CELL).long().unbind(dim=-1)
        rows, columns = self.depth.shape
        return depth <= self.depth[row.clamp(0, rows - 1), column.clamp(0, columns - 1)] + self.tolerance


def _factor(surface: Raster, scene: Scene) -> int:
    """How many pixels of the typical view a cell of the surface is wide."""
    known = scene.views.registered.nonzero()[:, 0]
    height = surface.height[surface.valid]
    if not len(height):
        return 1
    away = (scene.views.center[known, 2] - height.median()).abs()
    focal = scene.cameras.focal[scene.views.camera[known]].mean(dim=-1)
    return max(1, min(FINEST, round(surface.cell_size / float((away / focal).median()))))


def _finer(raster: Raster, factor: int) -> Raster:
    """With each cell divided; heights are interpolated between those of neighbours that have one."""
    if factor == 1:
        return raster
    known = raster.valid.to(raster.height.dtype)
    grids = torch.stack((raster.height * known, known))[None]
    height, share = interpolate(grids, scale_factor=factor, mode="bilinear", align_corners=False)[0]

    def repeated(grid: Shaped[Tensor, "rows columns *more"]) -> Shaped[Tensor, "finer_rows finer_columns *more"]:
        return grid.repeat_interleave(factor, dim=0).repeat_interleave(factor, dim=1)

    valid = repeated(raster.valid)
    return replace(
        raster,
        **{name: repeated(getattr(raster, name)) for name in ("sigma", "count", "colors", "filled", "views")},
        height=torch.where(valid, height / share.clamp(min=1e-12), 0.0),
        valid=valid,
        cell_size=raster.cell_size / factor,
    )


def _sides(surface: Raster) -> Float[Tensor, "n 3"]:
    """Points as far apart as cells are on the sides of what stands higher than its neighbours."""
    found = []
    for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
        other = torch.roll(surface.height, shift, axis)
        both = surface.valid & torch.roll(surface.valid, shift, axis)
        edge = 0 if shift == 1 else both.shape[axis] - 1
        both.select(axis, edge).fill_(False)
        steps = torch.where(both, (surface.height - other) / surface.cell_size, 0.0).floor().clamp(min=0.0).long()
        row, column = steps.nonzero().unbind(dim=-1)
        count = steps[row, column]
        which = torch.arange(len(row)).repeat_interleave(count)
        down = 1 + counted_in_runs(count)
        half = 0.5 * shift * surface.cell_size
        x = surface.x[column] - (half if axis == 1 else 0.0)
        y = surface.y[row] + (half if axis == 0 else 0.0)
        top = torch.stack((x, y, surface.height[row, column]), dim=-1)[which]
        found.append(top - torch.stack((0.0 * down, 0.0 * down, down * surface.cell_size), dim=-1))
    return torch.cat(found)


def _hiding(points: Float[Tensor, "n 3"], spacing: float, camera: RefractiveCamera) -> _Hiding:
    """The nearest surface before a camera: of points so far apart, each of which hides what lies behind it."""
    intrinsics = camera.intrinsics
    rows, columns = math.ceil(intrinsics.height / Z_CELL), math.ceil(intrinsics.width / Z_CELL)
    pixels, inside = camera.project(points, inside_image=True)
    depth = depth_in(camera, points)[inside]
    column, row = (pixels[inside] / Z_CELL).long().unbind(dim=-1)
    nearest = torch.full((rows * columns,), torch.inf, dtype=depth.dtype)
    nearest = nearest.scatter_reduce(0, row * columns + column, depth, "amin")
    return _Hiding(nearest.view(rows, columns), Z_TOLERANCE * spacing)


def _seen(
    cells: _Cells, camera: RefractiveCamera, view: int, images: Images, hiding: _Hiding
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Colours (RGB) of the cells in a view, and how much these count: 0 where they are not seen."""
    picture = torch.from_numpy(np.ascontiguousarray(read_color(images.capture.paths[view])[..., ::-1]))
    allowed = images.allowed(view)
    colors, weight = torch.zeros(len(cells.points), 3), torch.zeros(len(cells.points))
    planes = picture.permute(2, 0, 1).float()[None]
    for start in range(0, len(cells.points), BLOCK):
        points = cells.points[start : start + BLOCK]
        pixels, inside = camera.project(points, inside_image=True)
        shown = inside & hiding.shows(pixels, depth_in(camera, points))
        rows = shown.nonzero()[:, 0]
        pixels, points = pixels[rows], points[rows]
        column, row = pixels.long().unbind(dim=-1)
        usable = allowed[row.clamp(0, allowed.shape[0] - 1), column.clamp(0, allowed.shape[1] - 1)]
        colors[start + rows] = _sampled(planes, pixels)
        weight[start + rows] = (usable * _verticality(camera, points) * _taper(camera, pixels)).float()
    return colors, weight


def _sampled(planes: Float[Tensor, "1 3 height width"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    size = pixels.new_tensor((planes.shape[3], planes.shape[2]))
    grid = (2.0 * pixels / size - 1.0).float()[None, None]
    return grid_sample(planes, grid, mode="bilinear", padding_mode="border", align_corners=False)[0, :, 0].T


def _verticality(camera: RefractiveCamera, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Cosine to the fourth of the angle between the vertical and the line to the camera."""
    line = camera.center_in_world - points
    return (line[:, 2] / line.norm(dim=-1)).clamp(min=0.0) ** 4


def _taper(camera: RefractiveCamera, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    """From 1 to nearly 0 at the border of the photograph."""
    size = pixels.new_tensor((camera.intrinsics.width, camera.intrinsics.height))
    away = torch.minimum(pixels, size - pixels).amin(dim=-1) / (EDGE * float(size[0]))
    return away.clamp(1e-3, 1.0)


def _gains(cells: _Cells, scene: Scene, images: Images, hiding: dict[int, _Hiding]) -> dict[int, Float[Tensor, " 3"]]:
    """By what to multiply the colours of each view, so that those of one cell are the same in all: by turns the mean
    colour of the cells, and the median quotient of it and the view's own."""
    some = cells.sampled(SAMPLED)
    found = {view: _seen(some, scene.camera_of(view), view, images, hiding[view]) for view in hiding}
    gains = {view: torch.ones(3) for view in hiding}
    for _ in range(ROUNDS):
        total, weights = torch.zeros(len(some.points), 3), torch.zeros(len(some.points), 1)
        for view, (colors, weight) in found.items():
            total += weight[:, None] * colors * gains[view]
            weights += weight[:, None]
        mean = total / weights.clamp(min=1e-12)
        for view, (colors, weight) in found.items():
            both = (weight > 0.0) & (colors.amin(dim=-1) > 2.0) & (colors.amax(dim=-1) < 253.0)
            if bool(both.any()):
                gains[view] = (mean[both] / colors[both]).median(dim=0).values
        level = torch.stack(tuple(gains.values())).log().mean(dim=0).exp()
        gains = {view: gain / level for view, gain in gains.items()}
    return gains
