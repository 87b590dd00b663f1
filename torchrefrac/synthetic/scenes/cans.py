"""A glass tank with packets on a checkerboard, as in section 4.2 of Chang & Chen (ICCV 2011). Lengths in cm.

The tank is let into a bench and its walls are clad: nothing is seen through glass, or past the water.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import require
from torchrefrac.geometry.surfaces import Cylinder, Rectangle
from torchrefrac.synthetic.options import SyntheticOptions, require_heights, require_images
from torchrefrac.synthetic.paths import look_at, ring, rolls
from torchrefrac.synthetic.prints import checkerboard, label, tiles, wood
from torchrefrac.synthetic.scenes.shapes import footprint, level_rectangle, vector, walls
from torchrefrac.synthetic.stage import Piece, Stage
from torchrefrac.synthetic.textures import ImageTexture, SideBySide

INCH = 2.54
LENGTH, WIDTH, RIM = 15.0 * INCH, 12.5 * INCH, 2.0 * INCH  # of the tank; its rim above the water
BENCH = 70.0  # from the middle to the bench's edge
BOX_MIDDLE, BOX_SIZE, BOX_TURN_DEG, BOX_HIGH = (-7.5, 3.0), (10.0, 7.0), 12.0, 12.0
TEA_MIDDLE, TEA_RADIUS, TEA_HIGH = (8.0, -6.5), 4.2, 9.0
TUBE_FOOT, TUBE_RADIUS, TUBE_BEYOND = (7.0, 8.5), 1.7, 2.5
CREAM, BLUE, GREEN, WHITE = (236.0, 222.0, 180.0), (48.0, 84.0, 150.0), (70.0, 122.0, 76.0), (214.0, 216.0, 220.0)


@dataclass(frozen=True, kw_only=True)
class CansOptions(SyntheticOptions):
    """depth of the water, `images` cameras all around the tank at `heights` above the water in turn. All in cm.

    The tank measures 38.1 x 31.8, and its rim stands 5.1 above the water. On the checkerboard of its bottom stand a
    rectangular coffee can, a round tea can, and a tube that leans on the coffee can.
    """

    depth: float = 9.0 * INCH
    images: int = 18
    heights: tuple[float, ...] = (17.0, 21.0, 25.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.depth, "depth", at_least=BOX_HIGH + 4.0, at_most=100.0)
        require_images(self.images)
        require_heights(self.heights)
        if min(self.heights) < 2.0 * RIM:
            wanted = f"at least {2.0 * RIM:g}: the tank's rim is {RIM:g} above the water"
            raise ValueError(f"heights go down to {min(self.heights):g}, but must be {wanted}")


def cans_stage(options: CansOptions) -> Stage:
    """The tank under a lamp that stands to one side."""
    center = ring(options.images, (0.58 * LENGTH, 0.6 * WIDTH), options.heights, (-90.0, 270.0))
    floor, seed = -options.depth, 100 * options.seed
    return Stage(
        pieces=(*_tank(floor, seed), *_coffee(floor, seed), *_round_things(floor, seed)),
        rotation=look_at(center, vector((0.0, 0.0, 0.55 * floor)), rolls(options.images, 4.0)),
        center=center,
        length_unit="cm",
        towards_light=(0.5, 0.3, 1.0),
        ambient=0.72,
        direct=0.35,
    )


def _tank(floor: float, seed: int) -> list[Piece]:
    x, y = 0.5 * LENGTH, 0.5 * WIDTH
    inside = [(-x, -y), (-x, y), (x, y), (x, -y)]
    bottom = ImageTexture(checkerboard((1600, 1920), seed, columns=15, rows=12))
    pieces = [Piece("bottom", level_rectangle((-x, -y), (x, y), floor), bottom, is_plane=True)]
    for i, wall in enumerate(walls(inside, floor, RIM)):
        pieces.append(Piece(f"wall_{i}", wall, ImageTexture(tiles((832, 1088), seed + 10 + i))))
    around = (
        ((-BENCH, y), (BENCH, BENCH)), ((-BENCH, -BENCH), (BENCH, -y)), ((-BENCH, -y), (-x, y)), ((x, -y), (BENCH, y)),
    )  # fmt: skip
    for i, (low, high) in enumerate(around):
        size = (int(9 * (high[1] - low[1])), int(9 * (high[0] - low[0])))
        pieces.append(Piece(f"bench_{i}", level_rectangle(low, high, RIM), ImageTexture(wood(size, seed + 20 + i))))
    return pieces


def _coffee(floor: float, seed: int) -> list[Piece]:
    corners, top = footprint(BOX_MIDDLE, BOX_SIZE, BOX_TURN_DEG), floor + BOX_HIGH
    a, b, _, d = (vector((*corner, top)) for corner in corners)
    pieces = []
    for i, side in enumerate(walls(corners, floor, top)):
        wide = float(side.edge1.norm())
        image = label((960, int(80 * wide)), seed + 30 + i, words="COFFEE")
        pieces.append(Piece(f"coffee_side_{i}", side, ImageTexture(image), is_plane=True))
    lid = Rectangle(a, b - a, d - a)
    image = label((560, 800), seed + 34, words="MOCCA 500 g", ground=(120.0, 74.0, 44.0), ink=CREAM)
    return [*pieces, Piece("coffee_top", lid, ImageTexture(image), is_plane=True)]


def _round_things(floor: float, seed: int) -> list[Piece]:
    tea = Cylinder(vector((*TEA_MIDDLE, floor)), vector((0.0, 0.0, TEA_HIGH)), TEA_RADIUS)
    tea_side = label((560, 1640), seed + 40, words="ASSAM TEA", ground=GREEN, ink=CREAM)
    tea_lid = label((560, 560), seed + 41, words="TEA", ground=CREAM, ink=BLUE)
    corners = footprint(BOX_MIDDLE, BOX_SIZE, BOX_TURN_DEG)
    edge = 0.5 * (vector((*corners[1], floor + BOX_HIGH)) + vector((*corners[2], floor + BOX_HIGH)))
    tube = leaning(vector((*TUBE_FOOT, floor)), edge, TUBE_RADIUS, TUBE_BEYOND)
    lengthwise = label((720, 1400), seed + 42, words="DENTA fresh", ground=WHITE, ink=BLUE)
    tube_side = np.ascontiguousarray(np.rot90(lengthwise))
    tube_end = label((320, 320), seed + 43, words="D", ground=BLUE, ink=WHITE)
    return [
        Piece("tea", tea, SideBySide([ImageTexture(tea_side, repeat=True), *2 * [ImageTexture(tea_lid)]])),
        Piece("tube", tube, SideBySide([ImageTexture(tube_side, repeat=True), *2 * [ImageTexture(tube_end)]])),
    ]


def leaning(foot: Float[Tensor, " 3"], edge: Float[Tensor, " 3"], radius: float, beyond: float) -> Cylinder:
    """A cylinder that stands on the floor at `foot`, rests upon the point `edge`, and ends `beyond` it."""
    across = torch.nn.functional.normalize(torch.linalg.cross(vector((0.0, 0.0, 1.0)), edge - foot), dim=-1)
    along = torch.nn.functional.normalize(edge - foot, dim=-1)
    over = torch.linalg.cross(along, across)
    lift = radius * (over * over[2].sign())
    return Cylinder(foot + lift, along * (float((edge - foot).norm()) + beyond), radius)
