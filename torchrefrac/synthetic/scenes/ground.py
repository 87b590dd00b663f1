"""The ground under water: heights, as a surface too, and colours, as images whose first row is the northernmost."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped

from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.synthetic.patterns import Colours, grass, gravel, noise, sand

Heights = Float[np.ndarray, "rows columns"]
BANK = 0.48  # where the water ends, from the middle, in half widths of the ground


def cells(half: tuple[float, float], step: float) -> tuple[int, int]:
    """Rows and columns of cells of a ground, `step` wide."""
    return round(2.0 * half[1] / step), round(2.0 * half[0] / step)


def places(
    size: tuple[int, int], half: tuple[float, float]
) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, "rows 1"]]:
    """x and y of the centres of cells; the first row is the northernmost."""
    x = half[0] * (2.0 * (np.arange(size[1]) + 0.5) / size[1] - 1.0)
    y = half[1] * (1.0 - 2.0 * (np.arange(size[0]) + 0.5) / size[0])
    return x, y[:, None]


def bed(size: tuple[int, int], half: tuple[float, float], depth: float, rng: np.random.Generator) -> Heights:
    """Heights without boulders: a winding channel, deepest in the south, its bank in the north."""
    x, y = places(size, half)
    deepest = half[1] * (-0.18 + 0.10 * np.sin(2.2 * np.pi * x / (2.0 * half[0]) + 0.6))
    bank = half[1] * (BANK + 0.07 * np.sin(3.4 * np.pi * x / (2.0 * half[0]) + 2.0))
    north = (y - deepest) / (bank - deepest)
    south = (deepest - y) / (1.25 * half[1])
    wet = np.where(north > 0.0, np.abs(north) ** 2, south**2) - 1.0
    rising = 0.5 * (1.0 - np.exp(-np.clip(4.0 * (north - 1.0), 0.0, None)))
    profile = np.where(north < 1.0, wet, rising)
    rough = noise(size, rng, finest=4.0, decay=0.52)
    return (depth * (profile + 0.045 * rough)).astype(np.float64)


def boulders(half: tuple[float, float], count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 4"]:
    """x, y, radius, flatness, the small ones first."""
    radius = np.sort(0.18 + 0.13 * half[1] / 24.0 * rng.gamma(1.6, 1.0, count)).clip(max=0.07 * half[1])
    place = rng.uniform(-1.0, 1.0, (count, 2)) * half
    return np.column_stack((place, radius, rng.uniform(0.5, 0.95, count)))


def with_boulders(
    bed: Heights, half: tuple[float, float], boulders: Float[np.ndarray, "n 4"], rng: np.random.Generator
) -> Heights:
    """Domes of uneven outline, each where the bed is on average, sunk in a little."""
    x, y = places(bed.shape, half)
    uneven = (1.0 + 0.2 * noise(bed.shape, rng, finest=4.0, decay=0.7)).clip(0.6, 1.5)
    height = bed.copy()
    for east, north, radius, flat in boulders:
        reach = 1.3 * radius
        columns = slice(*np.searchsorted(x, (east - reach, east + reach)))
        rows = slice(*np.searchsorted(-y[:, 0], (-north - reach, -north + reach)))
        patch = height[rows, columns]
        if patch.size:
            square = ((x[columns] - east) ** 2 + (y[rows] - north) ** 2) * uneven[rows, columns]
            dome = flat * np.sqrt(np.clip(radius**2 - square, 0.0, None))
            raised = bed[rows, columns].mean() - 0.12 * radius + dome
            patch[:] = np.where(square < radius**2, np.maximum(patch, raised), patch)
    return height


def colours(
    size: tuple[int, int],
    half: tuple[float, float],
    height: Heights,
    rocky: Bool[np.ndarray, "rows columns"],
    boulders: Float[np.ndarray, "n 4"],
    seed: int,
) -> Colours:
    """Sand and stones on the bed, boulders where it is rocky, all darker at the water's edge, grass on the bank."""
    rng = np.random.default_rng(seed + 1)
    level = cv2.resize(height.astype(np.float32), size[::-1], interpolation=cv2.INTER_LINEAR)
    patchy = noise(size, rng, finest=24.0, decay=0.6)
    stones = gravel(size, 10 * seed + 3, stone=20.0, tint=9.0).astype(np.float32) * 1.15
    share = step(patchy + 0.9 * step(level / height.max() + 0.2), 0.25)
    colour = mixed(sand(size, 10 * seed + 4, ripple=26.0), stones, share)
    meadow = grass(size, 10 * seed + 5, blade=40.0).astype(np.float32) * 1.25
    colour = mixed(colour, meadow, step((level - 0.45 * height.max()) / (0.12 * height.max()) + 0.5 * patchy))
    rocks = np.ones(size, dtype=np.float32)
    tones = rng.uniform(0.55, 1.25, len(boulders))
    scale = size[1] / (2.0 * half[0])
    for (east, north, radius, _), tone in zip(boulders, tones, strict=True):
        where = (int((east + half[0]) * scale * 16), int((half[1] - north) * scale * 16))
        cv2.circle(rocks, where, int(1.3 * radius * scale * 16), float(tone), -1, shift=4)
    rough = 1.0 + 0.20 * noise(size, rng, decay=0.95) + 0.10 * noise(size, rng, decay=1.3)
    face = (rocks * rough)[..., None] * np.array((134.0, 130.0, 122.0), dtype=np.float32)
    edge = cv2.resize(rocky.astype(np.float32), size[::-1], interpolation=cv2.INTER_LINEAR)
    colour = mixed(colour, face, step(edge - 0.5, 0.3))
    damp = 1.0 - 0.35 * np.exp(-((level / (0.05 * height.max() + 0.01)) ** 2))
    return (colour * damp[..., None]).clip(0, 255).astype(np.uint8)


def height_field(height: Heights, half: tuple[float, float]) -> TriangleMesh:
    """Two triangles for every four neighbours; texture coordinates are those of an image that covers the ground."""
    rows, columns = height.shape
    x, y = places(height.shape, half)
    vertices = np.stack((np.broadcast_to(x, height.shape), np.broadcast_to(y, height.shape), height), axis=-1)
    node = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (corner.ravel() for corner in (node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]))
    faces = np.concatenate((np.stack((a, b, c), axis=-1), np.stack((a, c, d), axis=-1)))
    uv = 0.5 * (vertices.reshape(-1, 3)[:, :2] / np.array(half) + 1.0)
    return TriangleMesh(torch.from_numpy(vertices.reshape(-1, 3)), torch.from_numpy(faces), torch.from_numpy(uv))


def step(values: Float[np.ndarray, "h w"], width: float = 1.0) -> Float[np.ndarray, "h w"]:
    """0 far below zero, 1 far above."""
    return 1.0 / (1.0 + np.exp(-4.0 * np.clip(values / width, -10.0, 10.0)))


def mixed(
    first: Shaped[np.ndarray, "h w 3"], second: Shaped[np.ndarray, "h w 3"], share: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """The first colours where share is 0, the second where it is 1."""
    return first + (second - first) * share[..., None].astype(np.float32)
