"""What true cameras truly see, and how far points lie from it. For evaluation only."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.evaluate.mesh_distance import MeshDistance
from torchrefrac.geometry.polygon import inside_polygon
from torchrefrac.geometry.surfaces import Rectangle, Surface, nearest
from torchrefrac.scene.truth import Truth

TOLERANCE = 1e-6  # times the largest coordinate: single precision, in which files hold meshes, is ten times finer


class Seen(NamedTuple):
    """Points, the index of the true plane each lies on, -1 where on none, and where there is a point; elsewhere points
    are zero and the plane is -1."""

    points: Float[Tensor, "n 3"]
    plane: Int[Tensor, " n"]
    valid: Bool[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """All that true cameras see: the mesh of the truth, or its planes where it has none."""

    truth: Truth

    @property
    def is_known(self) -> bool:
        """Whether there is any."""
        return self.truth.surface is not None or len(self.truth.corner) > 0

    @cached_property
    def tolerance(self) -> float:
        """What is nearer to a plane than this lies on it, in length units: the mesh may come from a file of floats."""
        table = self.truth.corner if self.truth.surface is None else self.truth.surface.vertices
        return TOLERANCE * float(table.abs().max()) if table.numel() else 0.0

    def cast(self, cameras: RefractiveCamera, pixels: Float[Tensor, "n 2"]) -> Seen:
        """What cameras, n in all, with their true poses, intrinsics and water, see at pixels.

        What a ray meets before the water is seen dry. A ray that meets nothing, or is totally reflected, sees nothing.
        """
        surfaces = self._surfaces
        entry, before, after, wet = cameras.follow_rays(pixels)
        extent = self.truth.water_extent
        if extent is not None:
            wet = wet & inside_polygon(entry[:, :2], extent)
        center = cameras.center_in_world.expand_as(entry)
        length, which, _, _ = nearest(surfaces, entry, after)
        points = entry + torch.where(length.isfinite() & wet, length, 0.0)[:, None] * after
        valid = length.isfinite() & wet
        if self._rises or extent is not None:
            length, above, _, _ = nearest(surfaces, center, before)
            is_dry = length.isfinite() & (~wet | (length < (entry - center).norm(dim=-1)))
            dry = center + torch.where(is_dry, length, 0.0)[:, None] * before
            points = torch.where(is_dry[:, None], dry, points)
            which, valid = torch.where(is_dry, above, which), valid | is_dry
        points = torch.where(valid[:, None], points, 0.0)
        plane = which if self.truth.surface is None else self._plane_of(points)
        return Seen(points, torch.where(valid, plane, -1), valid)

    def distance(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Distance of points to the nearest place of the surface.

        That to a mesh is exact near it; see `MeshDistance.distance` for points that are far away. Raises ValueError
        where the truth has no surface.
        """
        if not self.is_known:
            raise ValueError("truth has neither planes nor a surface, but a distance needs one of them")
        return distance_to_rectangles(points, self.truth) if self._mesh is None else self._mesh.distance(points)

    def nearest_is_plane(self, points: Float[Tensor, "n 3"], distance: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """Whether the nearest place of the surface, `distance` from points, is on one of the planes."""
        if self.truth.surface is None or not len(self.truth.corner):
            return torch.full(points.shape[:1], len(self.truth.corner) > 0, device=points.device)
        return distance_to_rectangles(points, self.truth) <= distance + self.tolerance

    @cached_property
    def _surfaces(self) -> tuple[Surface, ...]:
        truth = self.truth
        if truth.surface is not None:
            return (truth.surface,)
        return tuple(map(Rectangle, truth.corner, truth.edge1, truth.edge2))

    @cached_property
    def _rises(self) -> bool:
        """Whether anything is above the water."""
        return any(bool((surface.triangles()[0][:, 2] > 0.0).any()) for surface in self._surfaces)

    @cached_property
    def _mesh(self) -> MeshDistance | None:
        mesh = self.truth.surface
        return None if mesh is None else MeshDistance.of(mesh.vertices, mesh.faces)

    def _plane_of(self, points: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
        if not len(self.truth.corner):
            return torch.full(points.shape[:1], -1)
        gap, plane = distance_to_each_rectangle(points, self.truth).min(dim=-1)
        return torch.where(gap <= self.tolerance, plane, -1)


def distance_to_rectangles(points: Float[Tensor, "n 3"], truth: Truth) -> Float[Tensor, " n"]:
    """Distance of points to the nearest true rectangle."""
    return distance_to_each_rectangle(points, truth).amin(dim=-1)


def distance_to_each_rectangle(points: Float[Tensor, "n 3"], truth: Truth) -> Float[Tensor, "n k"]:
    """Distances of points to the true rectangles."""
    offset = points[:, None] - truth.corner
    along1, along2 = (
        ((offset * edge).sum(dim=-1) / edge.square().sum(dim=-1)).clamp(0.0, 1.0) for edge in (truth.edge1, truth.edge2)
    )
    nearest_places = along1[..., None] * truth.edge1 + along2[..., None] * truth.edge2
    return (offset - nearest_places).norm(dim=-1)
