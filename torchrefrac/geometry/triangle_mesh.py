"""A surface of triangles, which Embree finds for the ray."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.geometry import triples
from torchrefrac.geometry.surfaces import NEAREST, Meeting


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A mesh of vertices in float64; uv: texture coordinates, by default x and y.

    Finds the face with Embree in single precision, and then the place on its plane in double precision.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    uv: Float[Tensor, "v 2"] | None = None

    @cached_property
    def _finder(self) -> tuple[Any, Float[Tensor, " 3"], float]:
        """The mesh as Embree has it, and the origin and scale of its coordinates, which single precision suits."""
        from embreex.mesh_construction import TriangleMesh as EmbreeMesh  # noqa: PLC0415 - needed only here
        from embreex.rtcore_scene import EmbreeScene  # noqa: PLC0415 - needed only here

        low, high = self.vertices.amin(dim=0), self.vertices.amax(dim=0)
        scale = 100.0 / max(float((high - low).max()), torch.finfo(torch.float64).tiny)
        scene = EmbreeScene()
        vertices = (scale * (self.vertices - low)).float().contiguous().numpy()
        EmbreeMesh(scene, vertices=vertices, indices=self.faces.int().contiguous().numpy())
        return scene, low, scale

    @cached_property
    def _planes(self) -> Float[Tensor, "f 12"]:
        """Of each face: unit normal n and offset n . x, then gradient and value at the world's origin of u and of v."""
        corners = self.vertices[self.faces]
        a, b, c = corners.unbind(dim=1)
        first, second = b - a, c - a
        across = torch.linalg.cross(first, second)
        area = across.square().sum(dim=-1, keepdim=True)
        normal = across / torch.where(area > 0.0, area, 1.0).sqrt()
        across = across / torch.where(area > 0.0, area, 1.0)
        weights = torch.stack((torch.linalg.cross(second, across), torch.linalg.cross(across, first)), dim=1)
        own = (self.vertices[:, :2] if self.uv is None else self.uv)[self.faces]
        gradient = (own[:, 1:] - own[:, :1]).mT @ weights
        value = own[:, 0] - (gradient @ a[..., None])[..., 0]
        offset = (normal * a).sum(dim=-1, keepdim=True)
        return torch.cat((normal, offset, gradient[:, 0], value[:, :1], gradient[:, 1], value[:, 1:]), dim=-1)

    def intersect(self, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Meeting:
        scene, low, scale = self._finder
        start, way = ((scale * (origins - low)).float().contiguous(), directions.float().contiguous())
        face = torch.from_numpy(scene.run(start.numpy(), way.numpy()))
        x, d = triples.split(origins), triples.split(directions)
        of_face = self._planes.index_select(0, face.clamp(min=0)).mT.contiguous()
        nx, ny, nz, offset, *of_uv = of_face.unbind()
        slope = triples.dot((nx, ny, nz), d)
        length = (offset - triples.dot((nx, ny, nz), x)) / torch.where(slope == 0.0, 1.0, slope)
        met = (face >= 0) & (slope != 0.0) & (length > NEAREST)
        point = x[0] + length * d[0], x[1] + length * d[1], x[2] + length * d[2]
        ux, uy, uz, u0, vx, vy, vz, v0 = of_uv
        uv = torch.stack((triples.dot((ux, uy, uz), point) + u0, triples.dot((vx, vy, vz), point) + v0))
        return Meeting(torch.where(met, length, torch.inf), uv.mT, of_face[:3].mT)

    def triangles(self) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
        return self.vertices, self.faces
