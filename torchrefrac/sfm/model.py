"""The reconstruction while it grows."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Tracks


@dataclass(frozen=True)
class SparseModel:
    """Poses of m images and points of T tracks, so far; every step makes a new one.

    registered (m); rotation (m, 3, 3), center (m, 3); points (T, 3) where has_point (T); active (N): the
    observations of `tracks` that support a point. index_ratio: scalar tensor.
    """

    tracks: Tracks
    registered: Tensor
    rotation: Tensor
    center: Tensor
    intrinsics: Intrinsics
    index_ratio: Tensor
    points: Tensor
    has_point: Tensor
    active: Tensor

    @classmethod
    def empty(cls, tracks: Tracks, num_images: int, intrinsics: Intrinsics, index_ratio: Tensor) -> "SparseModel":
        return cls(
            tracks=tracks,
            registered=torch.zeros(num_images, dtype=torch.bool),
            rotation=torch.eye(3, dtype=torch.float64).repeat(num_images, 1, 1),
            center=torch.zeros(num_images, 3, dtype=torch.float64),
            intrinsics=intrinsics,
            index_ratio=index_ratio,
            points=torch.zeros(tracks.num_tracks, 3, dtype=torch.float64),
            has_point=torch.zeros(tracks.num_tracks, dtype=torch.bool),
            active=torch.zeros(len(tracks.image), dtype=torch.bool),
        )

    @property
    def num_registered(self) -> int:
        return int(self.registered.sum())

    def cameras(self, image: Tensor) -> RefractiveCamera:
        """The cameras of images (*B), as a batch (*B)."""
        interface = FlatInterface(self.index_ratio)
        return RefractiveCamera(self.intrinsics, self.rotation[image], self.center[image], interface, check=False)

    def with_poses(self, images: Tensor | list[int], rotation: Tensor, center: Tensor) -> "SparseModel":
        """The model with `images` (k) registered at rotation (k, 3, 3) and center (k, 3)."""
        registered, rotations, centers = self.registered.clone(), self.rotation.clone(), self.center.clone()
        registered[images], rotations[images], centers[images] = True, rotation, center
        return replace(self, registered=registered, rotation=rotations, center=centers)

    def visible(self) -> Tensor:
        """Observations (N) in registered images."""
        return self.registered[self.tracks.image]

    def errors(self) -> Tensor:
        """Reprojection error (N) in pixels; inf where there is no pose, no point or no projection."""
        usable = self.visible() & self.has_point[self.tracks.track]
        rows = usable.nonzero()[:, 0]
        projected, valid = self.cameras(self.tracks.image[rows]).project(self.points[self.tracks.track[rows]])
        error = (projected - self.tracks.pixels[rows]).norm(dim=-1)
        result = torch.full((len(usable),), torch.inf, dtype=torch.float64)
        result[rows] = torch.where(valid, error, torch.inf)
        return result


def pad_by_track(tracks: Tracks, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Arrange the observations `rows` (k, ascending) as a table with one line a track.

    Returns the track of each line (L), the observations (L, n) and which entries are real (L, n).
    """
    ids, line, count = torch.unique_consecutive(tracks.track[rows], return_inverse=True, return_counts=True)
    width = int(count.max()) if len(count) else 0
    first = torch.cumsum(count, dim=0) - count
    slot = torch.arange(len(rows)) - first[line]
    table = torch.zeros(len(ids), width, dtype=torch.long)
    present = torch.zeros(len(ids), width, dtype=torch.bool)
    table[line, slot] = rows
    present[line, slot] = True
    return ids, table, present
