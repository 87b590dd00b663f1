"""A reef that a diver photographs with a camera in a housing, behind a flat port. Lengths in cm."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.checks import require, require_between
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.synthetic.options import InertialOptions, InterfaceOptions, SensorOptions, SyntheticOptions
from torchrefrac.synthetic.paths import grid, look_at, rolls
from torchrefrac.synthetic.patterns import Colours, coral, gravel, noise, rock, sand
from torchrefrac.synthetic.scenes.bodies import joined, stone
from torchrefrac.synthetic.scenes.ground import cells, height_field, mixed, places, step, with_boulders
from torchrefrac.synthetic.stage import Piece, Stage
from torchrefrac.synthetic.textures import ImageTexture

DEPTH = 130.0  # of the origin above the middle height of the ground: what stands there does not reach up to it
NODE, TEXEL = 1 / 130, 1 / 1050  # of the height field and of its texture, in mean altitudes
SWAY_DEG = 8.0
ACROSS = 85.0  # of the image of a rock's face
WATER = np.array((0.74, 0.95, 1.0), dtype=np.float32)  # the colour of what is seen through so much of it


@dataclass(frozen=True, kw_only=True)
class HousingOptions(SyntheticOptions):
    """A diver takes columns x rows photographs in strips to and fro, at `altitudes` (cm) above the ground in turn, that
    overlap by `overlap` (of their sides) and look down, but for some sway.

    On the ground of sand and rubble stand `rocks` of rock and coral. All of it, and the cameras, are under water; the
    origin lies 130 above the ground's middle height.
    """

    columns: int = 5
    rows: int = 4
    overlap: float = 0.7
    altitudes: tuple[float, ...] = (170.0, 225.0, 260.0, 190.0, 240.0, 280.0, 205.0)
    rocks: int = 44
    sensor: SensorOptions = field(default_factory=lambda: SensorOptions(samples=2))
    interface: InterfaceOptions = field(
        default_factory=lambda: InterfaceOptions(kind="port", glass_thickness=0.8, tilt_deg=(0.8, -0.6))
    )
    inertial: InertialOptions = field(
        default_factory=lambda: InertialOptions(gravity_sigma_deg=None, heading_sigma_deg=None)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, most in (("columns", 20), ("rows", 20)):
            require_between(getattr(self, name), name, 1, most)
        if self.columns * self.rows < 2:
            raise ValueError("columns and rows are both 1, but must be two photographs or more together")
        require(self.overlap, "overlap", at_least=0.3, at_most=0.95)
        if not self.altitudes:
            raise ValueError("altitudes is empty, but must be one or more altitudes above the ground, taken in turn")
        for altitude in self.altitudes:
            require(altitude, "altitudes", at_least=80.0, at_most=1000.0)
        require_between(self.rocks, "rocks", 0, 200)

    @property
    def altitude(self) -> float:
        """The mean."""
        return sum(self.altitudes) / len(self.altitudes)

    def reach(self, more_deg: float = 0.0) -> tuple[float, float]:
        """How far a camera that looks straight down sees to its side and to its top, in its altitudes; or how far by an
        angle more."""
        angles = (math.atan(0.5 * size / self.camera.focal) for size in (self.camera.width, self.camera.height))
        bent = (math.asin(math.sin(angle) / self.index_ratio) + math.radians(more_deg) for angle in angles)
        across, along = (math.tan(angle) for angle in bent)
        return across, along

    @property
    def spacing(self) -> tuple[float, float]:
        """Of photographs in a strip, and of strips."""
        across, along = (2.0 * (1.0 - self.overlap) * self.altitude * reach for reach in self.reach())
        return across, along

    @property
    def half_size(self) -> tuple[float, float]:
        """Of the ground, from the middle: more than what is seen."""
        beyond = self.reach(1.5 * SWAY_DEG)
        flown = (step * (n - 1) for step, n in zip(self.spacing, (self.columns, self.rows), strict=True))
        across, along = (0.5 * way + max(self.altitudes) * more for way, more in zip(flown, beyond, strict=True))
        return across, along


def housing_stage(options: HousingOptions) -> Stage:
    """The reef under the sun."""
    rng = np.random.default_rng(options.seed)
    half, seed = options.half_size, 100 * options.seed
    size = cells(half, NODE * options.altitude)
    undulating = -DEPTH + 7.0 * noise(size, rng, finest=4.0, decay=0.5).astype(np.float64)
    rubble = _scattered(half, 90, (5.0, 22.0), rng)
    height = with_boulders(undulating, half, rubble, rng)
    image = _colours(cells(half, TEXEL * options.altitude), seed)
    rotation, center = _dive(options)
    return Stage(
        pieces=(Piece("ground", height_field(height, half), ImageTexture(image)), *_reef(options, height, rng)),
        rotation=rotation,
        center=center,
        length_unit="cm",
        towards_light=(-0.35, 0.45, 0.85),
        ambient=0.55,
        direct=0.55,
        background=90.0,
    )


def _dive(options: HousingOptions) -> tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 3"]]:
    center = grid(options.columns, options.rows, options.spacing, 0.0)
    altitude = torch.tensor([options.altitudes[i % len(options.altitudes)] for i in range(len(center))])
    center[:, 2] = altitude - DEPTH
    sway = rolls(len(center), SWAY_DEG)
    below = center + altitude[:, None] * torch.stack((sway.tan(), sway.roll(3).tan(), -torch.ones_like(sway)), dim=-1)
    return look_at(center, below, rolls(len(center), 6.0).roll(5), up=(0.0, 1.0, 0.0)), center


def _scattered(
    half: tuple[float, float], count: int, radii: tuple[float, float], rng: np.random.Generator
) -> Float[np.ndarray, "count 4"]:
    """x, y, radius, flatness; many small ones, few large ones."""
    radius = radii[0] * (radii[1] / radii[0]) ** (rng.random(count) ** 1.5)
    return np.column_stack((rng.uniform(-1.0, 1.0, (count, 2)) * half, np.sort(radius), rng.uniform(0.5, 1.0, count)))


def _reef(options: HousingOptions, height: Float[np.ndarray, "rows columns"], rng: np.random.Generator) -> list[Piece]:
    """Rocks, and heads of coral, that stand on the ground."""
    x, y = places(height.shape, options.half_size)
    bodies: list[list[TriangleMesh]] = [[], []]
    seen = (0.85 * options.half_size[0], 0.85 * options.half_size[1])
    for i, (east, north, radius, flat) in enumerate(_scattered(seen, options.rocks, (11.0, 42.0), rng)):
        row, column = np.searchsorted(-y[:, 0], -north), np.searchsorted(x, east)
        tall = radius * (0.75 + 0.5 * flat) if i % 2 else radius * 0.8
        radii = np.array((radius, radius * rng.uniform(0.7, 1.1), min(tall, 60.0)))
        bodies[i % 2].append(stone(np.array((east, north, height[row, column] + 0.2 * tall)), radii, rng, ACROSS))
    crust = rock((640, 640), 100 * options.seed + 10, tone=(150.0, 118.0, 104.0))
    brain = coral((640, 640), 100 * options.seed + 11)
    return [
        Piece(name, joined(own), ImageTexture(_through_water(image), repeat=True))
        for name, own, image in (("rocks", bodies[1], crust), ("corals", bodies[0], brain))
        if own
    ]


def _colours(size: tuple[int, int], seed: int) -> Colours:
    """Sand with ripples, rubble, and crusts of algae on it."""
    rng = np.random.default_rng(seed + 1)
    rubble = gravel(size, seed + 2, stone=26.0, tint=16.0).astype(np.float32) * 1.1
    colour = mixed(
        sand(size, seed + 3, ripple=44.0), rubble, step(noise(size, rng, finest=60.0, decay=0.6) + 0.35, 0.5)
    )
    colour *= 1.0 + 0.12 * noise(size, rng, decay=1.1)[..., None]
    green, red = (step(noise(size, rng, finest=6.0, decay=0.9) - 1.0, 0.9)[..., None] for _ in range(2))
    colour = colour * (1.0 - green * np.array((0.45, 0.1, 0.5))) * (1.0 - red * np.array((-0.1, 0.4, 0.3)))
    return _through_water(colour)


def _through_water(colour: Shaped[np.ndarray, "h w 3"]) -> Colours:
    return (colour * WATER).clip(0, 255).astype(np.uint8)
