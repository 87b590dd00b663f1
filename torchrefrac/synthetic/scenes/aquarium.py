"""An aquarium that two phones photograph through its front of glass. Lengths in cm.

It is let into a cabinet, whose front is seen straight, around the glass. World z is the normal of the glass.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.geometry.surfaces import Cylinder, Rectangle
from torchrefrac.synthetic.options import (
    HeldCameraOptions,
    InertialOptions,
    InterfaceOptions,
    SensorOptions,
    SyntheticOptions,
    require_images,
)
from torchrefrac.synthetic.paths import look_at, rolls
from torchrefrac.synthetic.patterns import gravel, rock, scales
from torchrefrac.synthetic.prints import label, tiles, wood
from torchrefrac.synthetic.scenes.bodies import arch, fish, joined, stone
from torchrefrac.synthetic.scenes.cans import leaning
from torchrefrac.synthetic.scenes.shapes import footprint, level_rectangle, moved, rectangle, vector, walls
from torchrefrac.synthetic.stage import Piece, Stage
from torchrefrac.synthetic.textures import ImageTexture, SideBySide

WIDTH, DEPTH, HEIGHT = 80.0, 40.0, 45.0  # inside; depth is that behind the glass
LIP, CABINET, BEFORE = 1.5, 60.0, 0.4  # of the cabinet: over the glass at its edges, around it, before it
FRONT, BACK = 3.0, 9.0  # of the gravel: its height at the glass and at the back wall
WORLD_FROM_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
PHONES = (
    HeldCameraOptions(width=1024, height=768, fov_deg=60.0),
    HeldCameraOptions(width=768, height=1024, fov_deg=43.0),
)
STONES = ((-4.0, 12.0, 6.0), (9.0, 9.0, 4.5), (31.0, 30.0, 8.5), (-33.0, 9.0, 5.0), (19.0, 33.0, 6.0))  # x, y, radius
FISH = (
    (-20.0, 13.0, 29.0, 12.0, 20.0), (3.0, 20.0, 33.0, 10.0, 200.0), (24.0, 15.0, 26.0, 13.0, 160.0),
    (-6.0, 8.0, 20.0, 8.5, 350.0), (13.0, 28.0, 37.0, 9.0, 35.0), (33.0, 9.0, 35.0, 9.5, 215.0),
)  # fmt: skip
"""x, y, z, length, heading (degrees)."""
ACROSS = 36.0  # of the image of a stone's face
SANDSTONE = (190.0, 146.0, 104.0)
SKINS = (
    ((214.0, 128.0, 46.0), (236.0, 226.0, 208.0)), ((70.0, 112.0, 168.0), (214.0, 196.0, 92.0)),
    ((186.0, 182.0, 172.0), (60.0, 62.0, 76.0)), ((196.0, 84.0, 66.0), (238.0, 212.0, 170.0)),
    ((96.0, 150.0, 116.0), (46.0, 70.0, 92.0)), ((222.0, 196.0, 84.0), (92.0, 74.0, 60.0)),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class AquariumOptions(SyntheticOptions):
    """`images` cameras on an arc from the left to the right, at `distances` (cm) from the glass in turn.

    The tank measures 80 x 40 x 45 (width, depth behind the glass, height) and is full. On a slope of gravel stand a
    box, a can, a pillar, an arch and stones, and fish swim above.
    """

    images: int = 12
    distances: tuple[float, ...] = (52.0, 36.0, 34.0, 58.0, 44.0, 48.0, 28.0)
    cameras: tuple[HeldCameraOptions, ...] = PHONES
    sensor: SensorOptions = field(default_factory=lambda: SensorOptions(samples=2))
    interface: InterfaceOptions = field(default_factory=lambda: InterfaceOptions(kind="wall"))
    inertial: InertialOptions = field(default_factory=lambda: InertialOptions(heading_sigma_deg=None))

    def __post_init__(self) -> None:
        super().__post_init__()
        require_images(self.images)
        if not self.distances:
            raise ValueError("distances is empty, but must be one or more distances from the glass, taken in turn")
        for distance in self.distances:
            require(distance, "distances", above=BEFORE, at_most=1000.0)


def aquarium_stage(options: AquariumOptions) -> Stage:
    """The aquarium under a lamp that hangs over it, a little before its middle.

    It is put together upright: x to the right, y away from the glass, z up from its bottom.
    """
    center, target = _path(options)
    seed = 100 * options.seed
    upright = [*_tank(seed), *_furniture(seed), *_stones(seed), *_fish(seed), *_cabinet(options, seed)]
    turn = torch.tensor(WORLD_FROM_UPRIGHT, dtype=torch.float64)
    corner = vector((0.0, -0.5 * HEIGHT, -options.interface.glass_thickness))
    return Stage(
        pieces=tuple(replace(piece, surface=moved(piece.surface, turn, corner)) for piece in upright),
        rotation=look_at(center, target, rolls(options.images, 4.5)) @ turn.mT,
        center=center @ turn.mT + corner,
        length_unit="cm",
        towards_light=(0.15, 1.0, 0.55),
        ambient=0.68,
        direct=0.36,
    )


def _path(options: AquariumOptions) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Centres of cameras, and what they look at."""
    step = torch.linspace(-1.0, 1.0, options.images, dtype=torch.float64)
    distance = vector([options.distances[i % len(options.distances)] for i in range(options.images)])
    level = 22.0 + 11.0 * (2.1 * torch.arange(options.images, dtype=torch.float64) + 0.4).sin()
    center = torch.stack((33.0 * step, -options.interface.glass_thickness - distance, level), dim=-1)
    target = torch.stack((11.0 * step, torch.full_like(step, 17.0), 18.5 + 0.12 * (level - 22.0)), dim=-1)
    return center, target


def _tank(seed: int) -> list[Piece]:
    """Its walls but the front, the gravel, a lid, and a column that bears it."""
    x, back = 0.5 * WIDTH, DEPTH
    slope = rectangle((-x, 0.0, FRONT), (WIDTH, 0.0, 0.0), (0.0, DEPTH, BACK - FRONT))
    front = rectangle((-x, 0.05, 0.0), (WIDTH, 0.0, 0.0), (0.0, 0.0, FRONT))
    wall = rectangle((-x, back, 0.0), (WIDTH, 0.0, 0.0), (0.0, 0.0, HEIGHT))
    left = rectangle((-x, 0.0, 0.0), (0.0, DEPTH, 0.0), (0.0, 0.0, HEIGHT))
    right = rectangle((x, back, 0.0), (0.0, -DEPTH, 0.0), (0.0, 0.0, HEIGHT))
    column = Cylinder(vector((-9.0, 33.0, BACK - 4.0)), vector((0.0, 0.0, HEIGHT - BACK + 4.0)), 3.2)
    glazed = ImageTexture(tiles((1024, 640), seed + 6, tile=40.0), repeat=True)
    panel = (gravel((900, 1600), seed + 1, stone=84.0, tint=12.0) * np.array((0.55, 0.82, 1.05))).clip(0, 255)
    return [
        Piece("gravel", slope, ImageTexture(gravel((880, 1760), seed, stone=26.0, tint=16.0)), is_plane=True),
        Piece("gravel_front", front, ImageTexture(gravel((72, 1760), seed + 2, stone=26.0, tint=16.0))),
        Piece("back", wall, ImageTexture(panel.astype(np.uint8)), is_plane=True),
        Piece("left", left, ImageTexture(tiles((720, 640), seed + 3, tile=40.0)), is_plane=True),
        Piece("right", right, ImageTexture(tiles((720, 640), seed + 4, tile=40.0)), is_plane=True),
        Piece(
            "lid", level_rectangle((-x, 0.0), (x, back), HEIGHT), ImageTexture(wood((480, 960), seed + 5, plank=90.0))
        ),
        Piece("column", column, SideBySide(3 * [glazed])),
    ]


def _furniture(seed: int) -> list[Piece]:
    """A box, a can beside it, and a tube that leans on the box; sunk in so far that no gap is left."""
    corners, top = footprint((-22.0, 23.0), (15.0, 10.0), -18.0), 17.0
    a, b, _, d = (vector((*corner, top)) for corner in corners)
    pieces = []
    for i, side in enumerate(walls(corners, FRONT, top)):
        image = label((420, 450), seed + 10 + i, words="CORAL", ground=(150.0, 96.0, 58.0))
        pieces.append(Piece(f"box_side_{i}", side, ImageTexture(image)))
    lid = ImageTexture(label((300, 450), seed + 14, words="TREASURE", ground=(120.0, 74.0, 44.0)))
    pieces.append(Piece("box_top", Rectangle(a, b - a, d - a), lid, is_plane=True))
    can = Cylinder(vector((23.0, 15.0, FRONT)), vector((0.0, 0.0, 13.0)), 4.4)
    side = label((400, 840), seed + 20, words="ALGAE", ground=(60.0, 116.0, 92.0))
    end = ImageTexture(label((300, 300), seed + 21, words="A", ground=(196.0, 190.0, 168.0), ink=(40.0, 60.0, 90.0)))
    pieces.append(Piece("can", can, SideBySide([ImageTexture(side, repeat=True), end, end])))
    tube = leaning(vector((-7.0, 19.0, 5.0)), 0.5 * (b + vector((*corners[2], top))), 1.9, 3.0)
    image = ImageTexture(np.ascontiguousarray(np.rot90(label((360, 660), seed + 22, words="REEF 1 l"))), repeat=True)
    return [*pieces, Piece("tube", tube, SideBySide([image, end, end]))]


def _stones(seed: int) -> list[Piece]:
    """Stones on the slope, and an arch."""
    rng = np.random.default_rng(seed)
    stones = []
    for x, y, radius in STONES:
        middle = np.array((x, y, FRONT + (BACK - FRONT) * y / DEPTH + 0.35 * radius))
        stones.append(stone(middle, radius * rng.uniform(0.75, 1.1, 3), rng, ACROSS))
    bow = arch(np.array((9.0, 25.0, 7.0)), 17.0, 5.4, rng, ACROSS)
    mossy, sandy = rock((900, 900), seed + 30, tone=(104.0, 122.0, 88.0)), rock((900, 900), seed + 31, tone=SANDSTONE)
    return [
        Piece("stones", joined(stones), ImageTexture(mossy, repeat=True)),
        Piece("arch", bow, ImageTexture(sandy, repeat=True)),
    ]


def _fish(seed: int) -> list[Piece]:
    skins = [
        ImageTexture(scales((560, 420), seed + 40 + i, ground=ground, stripe=stripe))
        for i, (ground, stripe) in enumerate(SKINS)
    ]
    shoal = [fish(np.array((x, y, z)), length, heading_deg) for x, y, z, length, heading_deg in FISH]
    return [Piece("fish", joined(shoal, step=1.0), SideBySide(skins))]


def _cabinet(options: AquariumOptions, seed: int) -> list[Piece]:
    """Its front around the glass, in air."""
    y = -options.interface.glass_thickness - BEFORE
    x, low, high = 0.5 * WIDTH - LIP, LIP, HEIGHT - LIP
    middle = 0.5 * HEIGHT
    parts = (
        ((-CABINET, high), (CABINET, middle + CABINET)), ((-CABINET, middle - CABINET), (CABINET, low)),
        ((-CABINET, low), (-x, high)), ((x, low), (CABINET, high)),
    )  # fmt: skip
    pieces = []
    for i, ((left, bottom), (right, top)) in enumerate(parts):
        board = rectangle((left, y, bottom), (right - left, 0.0, 0.0), (0.0, 0.0, top - bottom))
        image = wood((round(14 * (top - bottom)), round(14 * (right - left))), seed + 50 + i)
        pieces.append(Piece(f"cabinet_{i}", board, ImageTexture(image)))
    return pieces
