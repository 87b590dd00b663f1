"""Round bodies as meshes: stones, an arch and fish. Each is swept by rings of points."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.synthetic.scenes.mesh_colours import box_uv

RINGS, AROUND = 28, 56
BUMPS = 14


def stone(
    middle: Float[np.ndarray, " 3"], radii: Float[np.ndarray, " 3"], rng: np.random.Generator, across: float
) -> TriangleMesh:
    """An uneven ellipsoid. across: how wide the image is that is laid on it from six sides."""
    polar = np.linspace(0.0, np.pi, RINGS)[:, None, None]
    around = (2.0 * np.pi / AROUND * np.arange(AROUND))[:, None]
    out = np.concatenate(np.broadcast_arrays(*(
        np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), -np.cos(polar)
    )), axis=-1)  # fmt: skip
    return _sided(middle + radii * _uneven(out, 0.055, 3.2, rng) * out, across)


def arch(
    foot: Float[np.ndarray, " 3"], span: float, thickness: float, rng: np.random.Generator, across: float
) -> TriangleMesh:
    """Half a ring along x about `foot`, `span` wide from middle to middle of its legs, which reach into the floor.
    across: how wide the image is that is laid on it from six sides."""
    turn = np.linspace(-0.15 * np.pi, 1.15 * np.pi, 2 * RINGS)[:, None, None]
    around = (2.0 * np.pi / AROUND * np.arange(AROUND))[:, None]
    out = np.concatenate((np.cos(turn), np.zeros_like(turn), np.sin(turn)), axis=-1)
    sideways = np.cos(around) * out + np.sin(around) * np.array((0.0, 1.0, 0.0))
    uneven = _uneven(0.12 * span * out + sideways, 0.05, 2.6, rng)
    return _sided(foot + 0.5 * span * out + 0.5 * thickness * uneven * sideways, across)


def fish(middle: Float[np.ndarray, " 3"], length: float, heading_deg: float) -> TriangleMesh:
    """A fish that swims level towards its heading, from +x towards +y; its texture runs up from tail to nose."""
    along = np.linspace(0.0, 1.0, RINGS)[:, None]
    body = np.sin(np.pi * np.clip((1.0 - along) / 0.86, 0.0, 1.0) ** 0.72)
    tail = np.clip(1.0 - along / 0.2, 0.0, 1.0) ** 1.2
    high, wide = 0.185 * body + 0.15 * tail + 0.012, 0.085 * body + 0.007
    around = 2.0 * np.pi / AROUND * np.arange(AROUND)  # from its belly
    ahead, side, up = np.broadcast_arrays(along - 0.5, wide * np.sin(around), -high * np.cos(around))
    c, s = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
    return _swept(middle + length * np.stack((c * ahead - s * side, s * ahead + c * side, up), axis=-1))


def joined(bodies: Sequence[TriangleMesh], step: float = 0.0) -> TriangleMesh:
    """All bodies as one mesh; u of each begins `step` after that of the one before, 1 for textures `SideBySide`."""
    first = np.cumsum([0, *(len(body.vertices) for body in bodies)]).tolist()
    places = [body.uv + torch.tensor((i * step, 0.0)) for i, body in enumerate(bodies) if body.uv is not None]
    faces = [body.faces + start for body, start in zip(bodies, first, strict=False)]
    return TriangleMesh(torch.cat([body.vertices for body in bodies]), torch.cat(faces), torch.cat(places))


def _uneven(
    place: Float[np.ndarray, "*batch 3"], strength: float, fineness: float, rng: np.random.Generator
) -> Float[np.ndarray, "*batch 1"]:
    """Numbers about 1 that vary smoothly with the place, by sines of random directions."""
    number = fineness * rng.normal(0.0, 1.0, (3, BUMPS))
    return 1.0 + strength * np.sin(place @ number + rng.uniform(0.0, 2.0 * np.pi, BUMPS)).sum(axis=-1, keepdims=True)


def _swept(rings: Float[np.ndarray, "rings around 3"]) -> TriangleMesh:
    """The surface between neighbouring rings. Texture coordinates: u once around each, v from the first to the last."""
    closed = np.concatenate((rings, rings[:, :1]), axis=1)
    rows, columns = closed.shape[:2]
    v, u = np.meshgrid(np.linspace(0.0, 1.0, rows), np.linspace(0.0, 1.0, columns), indexing="ij")
    node = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (corner.ravel() for corner in (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]))
    faces = np.concatenate((np.stack((a, b, c), axis=-1), np.stack((a, c, d), axis=-1)))
    return TriangleMesh(*(torch.from_numpy(table) for table in (
        closed.reshape(-1, 3), faces, np.stack((u, v), axis=-1).reshape(-1, 2)
    )))  # fmt: skip


def _sided(rings: Float[np.ndarray, "rings around 3"], across: float) -> TriangleMesh:
    """The surface between rings, and an image, so wide, that is laid on it from six sides."""
    mesh = _swept(rings)
    corners = mesh.vertices[mesh.faces]
    own = torch.arange(3 * len(corners)).reshape(-1, 3)
    longest = float((mesh.vertices.amax(dim=0) - mesh.vertices.amin(dim=0)).max())
    return TriangleMesh(corners.reshape(-1, 3), own, longest / across * box_uv(corners))
