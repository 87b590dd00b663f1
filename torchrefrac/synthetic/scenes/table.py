"""A basin of water on a table: much of what is seen lies below the water's level, but not in it. Lengths in cm."""

from dataclasses import dataclass

from torchrefrac.checks import require
from torchrefrac.synthetic.options import SyntheticOptions, require_heights, require_images
from torchrefrac.synthetic.paths import look_at, ring, rolls
from torchrefrac.synthetic.patterns import beans, grass, gravel
from torchrefrac.synthetic.prints import label, tiles
from torchrefrac.synthetic.scenes.shapes import footprint, level_rectangle, rectangle, vector, walls
from torchrefrac.synthetic.stage import Piece, Stage
from torchrefrac.synthetic.textures import ImageTexture

LENGTH, WIDTH, WALL, RIM = 70.0, 54.0, 1.5, 1.5  # of the water, and of the basin's wall: thickness, height above it
TABLE = 130.0  # from the middle to the table's edge
BOX_MIDDLE, BOX_SIZE, BOX_HIGH = (52.0, 12.0), (20.0, 14.0), 9.0


@dataclass(frozen=True, kw_only=True)
class TableOptions(SyntheticOptions):
    """depth of the water; `images` cameras on a ring of `radius` about the middle, at `heights` above it in turn.

    The water measures 70 x 54; a plate leans in it. The basin stands on a table, which lies a little deeper than its
    bottom, and a box beside it. All in cm.
    """

    depth: float = 22.0
    images: int = 12
    radius: float = 42.0
    heights: tuple[float, ...] = (45.0, 55.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.depth, "depth", at_least=BOX_HIGH + WALL, at_most=100.0)
        require_images(self.images)
        require(self.radius, "radius", above=0.0, at_most=TABLE)
        require_heights(self.heights)
        if min(self.heights) < 4.0 * RIM:
            wanted = f"at least {4.0 * RIM:g}: the basin's rim is {RIM:g} above the water"
            raise ValueError(f"heights go down to {min(self.heights):g}, but must be {wanted}")


def table_stage(options: TableOptions) -> Stage:
    """The table, lit evenly from everywhere."""
    center = ring(options.images, options.radius, options.heights, (-150.0, 150.0))
    x, y, seed = 0.5 * LENGTH, 0.5 * WIDTH, 10 * options.seed
    return Stage(
        pieces=(*_basin(options.depth, seed), *_around(-options.depth - WALL, seed)),
        rotation=look_at(center, vector((0.0, 0.0, -0.5 * options.depth)), rolls(options.images, 4.5)),
        center=center,
        length_unit="cm",
        water_extent=((-x, -y), (x, -y), (x, y), (-x, y)),
    )


def _basin(depth: float, seed: int) -> list[Piece]:
    """What holds the water, and a plate in it."""
    x, y, floor = 0.5 * LENGTH, 0.5 * WIDTH, -depth
    inside = [(-x, -y), (-x, y), (x, y), (x, -y)]
    outside = footprint((0.0, 0.0), (LENGTH + 2.0 * WALL, WIDTH + 2.0 * WALL))
    bottom, slant = level_rectangle((-x, -y), (x, y), floor), 0.7 * depth
    plate = rectangle((-14.0, -16.0, floor + 0.5), (0.0, 32.0, 0.0), (-18.0, 0.0, slant))
    pieces = [
        Piece("bottom", bottom, ImageTexture(gravel((1024, 1328), seed + 1)), is_plane=True),
        Piece("plate", plate, ImageTexture(beans((512, 512), seed + 2)), is_plane=True),
    ]
    sides = [*walls(inside, floor, RIM), *walls(outside, floor - WALL, RIM)]
    for i, side in enumerate(sides):
        pieces.append(Piece(f"side_{i}", side, ImageTexture(tiles((256, 640), seed + 3 + i))))
    rim = (((-x, y), (x, y + WALL)), ((-x, -y - WALL), (x, -y)), ((-x - WALL, -y - WALL), (-x, y + WALL)),
           ((x, -y - WALL), (x + WALL, y + WALL)))  # fmt: skip
    for i, (low, high) in enumerate(rim):
        pieces.append(Piece(f"rim_{i}", level_rectangle(low, high, RIM), ImageTexture(tiles((64, 640), seed + 11 + i))))
    return pieces


def _around(level: float, seed: int) -> list[Piece]:
    """The table about the basin, and a box on it."""
    x, y = 0.5 * LENGTH + WALL, 0.5 * WIDTH + WALL
    parts = (((-TABLE, y), (TABLE, TABLE)), ((-TABLE, -TABLE), (TABLE, -y)), ((-TABLE, -y), (-x, y)),
             ((x, -y), (TABLE, y)))  # fmt: skip
    pieces = []
    for i, (low, high) in enumerate(parts):
        size = (round(10 * (high[1] - low[1])), round(10 * (high[0] - low[0])))
        image = ImageTexture(grass(size, seed + 20 + i))
        pieces.append(Piece(f"table_{i}", level_rectangle(low, high, level), image, is_plane=True))
    corners, top = footprint(BOX_MIDDLE, BOX_SIZE, 20.0), level + BOX_HIGH
    for i, side in enumerate(walls(corners, level, top)):
        pieces.append(Piece(f"box_side_{i}", side, ImageTexture(label((360, 640), seed + 30 + i, words="TEA"))))
    (ax, ay), (bx, by), _, (dx, dy) = corners
    lid = rectangle((ax, ay, top), (bx - ax, by - ay, 0.0), (dx - ax, dy - ay, 0.0))
    image = ImageTexture(label((480, 640), seed + 34, words="MOCCA"))
    return [*pieces, Piece("box_top", lid, image, is_plane=True)]
