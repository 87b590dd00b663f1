"""The colours of a mesh: its own image, those of its vertices or faces, or stone where it has none."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.synthetic.patterns import gravel
from torchrefrac.synthetic.stage import Texture
from torchrefrac.synthetic.textures import ImageTexture, VertexColours, corner_uv

if TYPE_CHECKING:
    import trimesh

SHIFTS = ((0.0, 0.0), (0.53, 0.31), (0.21, 0.67), (0.77, 0.13), (0.37, 0.83), (0.11, 0.47))  # of the six sides of a box


def coloured(mesh: "trimesh.Trimesh", vertices: Float[Tensor, "v 3"], seed: int) -> tuple[TriangleMesh, Texture]:
    """The mesh with its vertices at their place, and its texture."""
    faces = torch.as_tensor(np.array(mesh.faces), dtype=torch.int64)
    image, uv = _image(mesh), getattr(mesh.visual, "uv", None)
    if image is not None and uv is not None and len(uv) == len(vertices):
        placed = torch.as_tensor(np.array(uv), dtype=torch.float64).nan_to_num()
        return TriangleMesh(vertices, faces, placed), ImageTexture(image, repeat=True)
    apart = vertices[faces].reshape(-1, 3)
    own = torch.arange(len(apart)).reshape(-1, 3)
    colours = _corner_colours(mesh)
    if colours is not None:
        return TriangleMesh(apart, own, corner_uv(len(faces))), VertexColours(colours)
    stone = ImageTexture(gravel((1536, 1536), 10 * seed + 1, stone=36.0, tint=14.0), repeat=True)
    return TriangleMesh(apart, own, box_uv(vertices[faces])), stone


def _image(mesh: "trimesh.Trimesh") -> UInt8[np.ndarray, "height width 3"] | None:
    """The picture of the mesh's material, where it has one."""
    material: Any = getattr(mesh.visual, "material", None)
    pictures = (getattr(material, name, None) for name in ("image", "baseColorTexture"))
    picture = next((picture for picture in pictures if picture is not None), None)
    return None if picture is None else np.array(picture.convert("RGB"), dtype=np.uint8)


def _corner_colours(mesh: "trimesh.Trimesh") -> Float32[Tensor, "f 3 3"] | None:
    """Of the corners of each face, where vertices or faces have colours of their own."""
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        table = np.array(visual.vertex_colors)[:, :3][np.array(mesh.faces)]
    elif visual.kind == "face":
        table = np.repeat(np.array(visual.face_colors)[:, None, :3], 3, axis=1)
    else:
        return None
    return torch.from_numpy(table.astype(np.float32))


def box_uv(corners: Float[Tensor, "f 3 3"]) -> Float[Tensor, "3*f 2"]:
    """Texture coordinates of the corners of triangles: the image is laid on each side of a box about the mesh,
    and a face has that of the side that it faces most. Once across the image is the longest side of the box."""
    low, high = corners.reshape(-1, 3).amin(dim=0), corners.reshape(-1, 3).amax(dim=0)
    inside = (corners - low) / (high - low).max()
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = normal.abs().argmax(dim=-1)
    side = 2 * axis + (normal.gather(1, axis[:, None])[:, 0] < 0.0)
    others = torch.tensor(((1, 2), (0, 2), (0, 1)))[axis]
    flat = inside.gather(2, others[:, None, :].expand(-1, 3, -1))
    return (flat + torch.tensor(SHIFTS, dtype=flat.dtype)[side][:, None]).reshape(-1, 2)
