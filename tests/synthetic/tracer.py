"""A tracer in NumPy that follows rays one by one: by Snell's law from layer to layer, then to every surface."""

import math
from itertools import pairwise

import numpy as np

MISSED = (math.inf, None)


def meets(surface, origin, way):
    """Length at which one ray meets a rectangle, a cylinder or a mesh, by its textbook formula, infinite for a miss;
    and texture coordinates, None of a cylinder."""
    if hasattr(surface, "corner"):
        matrix = np.stack((-way, surface.edge1.numpy(), surface.edge2.numpy()), axis=-1)
        length, u, v = np.linalg.solve(matrix, origin - surface.corner.numpy())
        return (length, np.array((u, v))) if length > 1e-9 and 0 <= u <= 1 and 0 <= v <= 1 else MISSED
    if hasattr(surface, "faces"):
        return _meets_mesh(surface, origin, way)
    base, axis, radius = surface.base.numpy(), surface.axis.numpy(), surface.radius
    height = np.linalg.norm(axis)
    axis = axis / height
    start = origin - base
    across, tilt = start - (start @ axis) * axis, way - (way @ axis) * axis
    roots = np.roots((tilt @ tilt, 2 * across @ tilt, across @ across - radius**2))
    lengths = [r.real for r in roots if abs(r.imag) < 1e-12 and 0 <= (start + r.real * way) @ axis <= height]
    for level in (0.0, height):
        length = (level - start @ axis) / (way @ axis)
        on_plane = start + length * way
        if np.linalg.norm(on_plane - (on_plane @ axis) * axis) <= radius:
            lengths.append(length)
    return min((length for length in lengths if length > 1e-9), default=math.inf), None


def _meets_mesh(mesh, origin, way):
    """By Cramer's rule for every triangle."""
    a, b, c = np.moveaxis(mesh.vertices.numpy()[mesh.faces.numpy()], 1, 0)
    first, second, start = b - a, c - a, origin - a
    across = np.cross(way, second)
    volume = (first * across).sum(axis=-1)
    volume[volume == 0.0] = np.inf
    u, turned = (start * across).sum(axis=-1) / volume, np.cross(start, first)
    v, length = turned @ way / volume, (second * turned).sum(axis=-1) / volume
    length[~((u >= 0) & (v >= 0) & (u + v <= 1) & (length > 1e-9))] = np.inf
    nearest = int(length.argmin())
    if length[nearest] == math.inf:
        return MISSED
    corner_uv = (mesh.vertices[:, :2] if mesh.uv is None else mesh.uv).numpy()[mesh.faces[nearest].numpy()]
    weights = np.array((1.0 - u[nearest] - v[nearest], u[nearest], v[nearest]))
    return length[nearest], weights @ corner_uv


def refracted(way, normal, first, second):
    """Snell's law in vector form, from an index into another, at a surface of a unit normal against the ray; None where
    all is reflected."""
    ratio, cosine = first / second, -normal @ way
    square = 1.0 - ratio**2 * (1.0 - cosine**2)
    return None if square < 0.0 else ratio * way + (ratio * cosine - math.sqrt(square)) * normal


def through_layers(center, way, point, normal, indices, thickness):
    """Where one ray leaves the last of flat layers, and its direction from there: the first face goes through a point,
    its unit normal is on the side of the ray. None where it does not get through; and how far it is to the first."""
    if normal @ way >= 0.0:
        return None, math.inf
    place, reach = center, math.inf
    for i, (first, second) in enumerate(pairwise(indices)):
        on_face = point - sum(thickness[:i]) * normal
        length = ((on_face - place) @ normal) / (way @ normal)
        reach = length if i == 0 else reach
        place, way = place + length * way, refracted(way, normal, first, second)
        if way is None:
            return None, reach
    return (place, way), reach


def end_of(surfaces, origin, way):
    """Of one ray: length, index of the surface (-1: none) and texture coordinates."""
    found = [meets(surface, origin, way) for surface in surfaces]
    best = min(range(len(found)), key=lambda i: found[i][0])
    return (math.inf, -1, None) if found[best][0] == math.inf else (found[best][0], best, found[best][1])
