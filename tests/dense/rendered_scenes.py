"""Photographs of painted planes through water, made pixel by pixel without the package's own refraction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.dense.atlas import Atlas
from torchrefrac.dense.matching.interest_points import InterestPoints, detect_interest_points
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.scope import Scope
from torchrefrac.refraction import FlatInterface

FOCAL = 150.0
WIDTH, HEIGHT = 160, 120


@dataclass(frozen=True)
class Board:
    """A flat piece of surface: a point of it, its normal (of any length), and how far it reaches from that point."""

    point: tuple[float, float, float]
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    reach: float = np.inf


@dataclass(frozen=True)
class Rendered:
    """cameras (m); images (m, h, w) grey, float32; points (m, h, w, 3): what each pixel shows; normals (m, h, w, 3)."""

    cameras: RefractiveCamera
    images: Tensor
    points: Tensor
    normals: Tensor

    def scope(self, near: float, far: float, options: DenseOptions, allowed: Tensor | None = None) -> Scope:
        """The first image is the reference, the tile all of it."""
        count, height, width = self.images.shape
        atlas = Atlas.build(list(self.images), options.levels, mode=options.interpolation)

        def interest_points(image: int) -> InterestPoints:
            return detect_interest_points(self.images[image].float(), per_cell=1)

        ids, tile, none = torch.arange(count), (0, 0, width, height), torch.zeros(0, 3, dtype=torch.float64)
        return Scope(ids, self.cameras, near, far, none, none[:, :2], atlas, allowed, tile, interest_points)

    def at(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Points and unit normals (k, 3) that the reference shows at pixels (k, 2), which are middles of pixels."""
        column, row = pixels.floor().long().unbind(dim=-1)
        return self.points[0, row, column], self.normals[0, row, column]


def cameras_around(count: int, height: float, aim: float, index_ratio: float, reach: float = 11.0) -> RefractiveCamera:
    """Cameras `height` above the water on a circle of radius `reach`, which look at (0, 0, aim)."""
    angle = 2.0 * np.pi * np.arange(count) / count + 0.3
    center = np.stack((reach * np.cos(angle), reach * np.sin(angle), height + np.arange(count)), axis=-1)
    forward = np.array((0.0, 0.0, aim)) - center
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, (0.1, 1.0, 0.2))
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    rotation = np.stack((right, np.cross(forward, right), forward), axis=-2)
    lens = Intrinsics.create(WIDTH, HEIGHT, FOCAL)
    return RefractiveCamera(lens, torch.from_numpy(rotation), torch.from_numpy(center), FlatInterface(index_ratio))


def marble(contrast: float = 45.0, finest: float = 2.0, coarsest: float = 12.0) -> Callable[[np.ndarray], np.ndarray]:
    """Grey values of points (*B, 3): waves through space of all lengths between two, a texture for any surface."""
    random = np.random.default_rng(5)
    direction = random.normal(size=(60, 3))
    length = np.exp(random.uniform(np.log(finest), np.log(coarsest), size=(60, 1)))
    wave = 2.0 * np.pi * direction / np.linalg.norm(direction, axis=-1, keepdims=True) / length
    phase = random.uniform(0.0, 2.0 * np.pi, size=60)

    def grey(points: np.ndarray) -> np.ndarray:
        return 128.0 + contrast * np.sqrt(2.0 / len(wave)) * np.sin(points @ wave.T + phase).sum(axis=-1)

    return grey


def render(
    boards: Sequence[Board],
    cameras: RefractiveCamera,
    texture: Callable[[np.ndarray], np.ndarray],
    index_ratio: float,
) -> Rendered:
    """What cameras (m) without distortion see of boards above and below the water, z = 0; one ray for each pixel.

    The boards must fill the images. texture tells the grey values of points (*B, 3). The ray goes straight to the
    water, where the sine of its angle with the vertical is divided by index_ratio: nothing of the package is used but
    the cameras' numbers.
    """
    lens = cameras.intrinsics
    column, row = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    plane = (np.stack((column, row), axis=-1) - lens.principal_point.numpy()) / lens.focal.numpy()
    in_cam = np.concatenate((plane, np.ones((*column.shape, 1))), axis=-1)
    images, points, normals = [], [], []
    for rotation, center in zip(cameras.cam_from_world_rotation.numpy(), cameras.center_in_world.numpy(), strict=True):
        view = in_cam @ rotation
        view /= np.linalg.norm(view, axis=-1, keepdims=True)
        steep = view[..., 2:] < -1e-3
        entry = center + view * np.where(steep, center[2] / -np.where(steep, view[..., 2:], -1.0), 1e6)
        across = view[..., :2] / np.maximum(np.linalg.norm(view[..., :2], axis=-1, keepdims=True), 1e-12)
        sine = np.linalg.norm(view[..., :2], axis=-1, keepdims=True) / index_ratio
        bent = np.concatenate((across * sine, -np.sqrt(1.0 - sine**2)), axis=-1)
        point, normal = _nearest(boards, center, view, entry, bent)
        images.append(texture(point))
        points.append(point)
        normals.append(normal)
    grey, point, normal = (torch.from_numpy(np.stack(arrays)) for arrays in (images, points, normals))
    return Rendered(cameras, grey.float(), point, normal)


def _nearest(boards, center, view, entry, bent):
    """Where the rays first end (h, w, 3), on their way to the water or after it, and the normals there."""
    dry_length = np.linalg.norm(entry - center, axis=-1)
    best = np.full(dry_length.shape, np.inf)
    point, normal = np.zeros_like(entry), np.zeros_like(entry)
    for board in boards:
        unit = np.array(board.normal) / np.linalg.norm(board.normal)
        dry = ((board.point - center) @ unit) / (view @ unit)
        wet = ((board.point - entry) @ unit) / (bent @ unit)
        for length, way, where, passes in (
            (dry, dry, center + dry[..., None] * view, (dry > 0) & (dry < dry_length)),
            (dry_length + wet, wet, entry + wet[..., None] * bent, wet > 0),
        ):
            hit = passes & np.isfinite(way) & (length < best)
            hit &= np.linalg.norm(where - np.array(board.point), axis=-1) < board.reach
            best = np.where(hit, length, best)
            point, normal = np.where(hit[..., None], where, point), np.where(hit[..., None], unit, normal)
    assert np.isfinite(best).all(), "a pixel sees none of the boards"
    return point, normal
