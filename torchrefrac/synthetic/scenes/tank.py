"""A tank with two slanted planes, as in section 4.1 of Chang & Chen (ICCV 2011). Lengths in cm."""

from dataclasses import dataclass

from torchrefrac.checks import require
from torchrefrac.synthetic.options import SyntheticOptions, require_heights, require_images
from torchrefrac.synthetic.paths import look_at, ring, rolls
from torchrefrac.synthetic.patterns import beans, grass, gravel
from torchrefrac.synthetic.scenes.shapes import level_rectangle, rectangle, vector
from torchrefrac.synthetic.stage import Piece, Stage
from torchrefrac.synthetic.textures import ImageTexture

HALF_SIDE = 100.0
LOW, LEAN = 8.0, (64.9519052838329, 37.5)  # of the planes: lower edge above the bottom; 75 cm at 30 degrees
SECTOR_DEG = (-105.0, 105.0)


@dataclass(frozen=True, kw_only=True)
class TankOptions(SyntheticOptions):
    """depth of the water; `images` cameras on an arc of `radius` about the middle, at `heights` above it in turn.

    The bottom measures 200 x 200; on it stand two planes of 90 x 75, tilted by 30 degrees either way. All in cm.
    """

    depth: float = 100.0
    images: int = 12
    radius: float = 55.0
    heights: tuple[float, ...] = (30.0, 40.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.depth, "depth", above=LOW + LEAN[1], at_most=1000.0)
        require_images(self.images)
        require(self.radius, "radius", above=0.0, at_most=HALF_SIDE)
        require_heights(self.heights)


def tank_stage(options: TankOptions) -> Stage:
    """The tank, lit evenly from everywhere."""
    center = ring(options.images, options.radius, options.heights, SECTOR_DEG)
    target = vector((0.0, 0.0, -0.75 * options.depth))
    floor, low = -options.depth, LOW - options.depth
    bottom = level_rectangle((-HALF_SIDE, -HALF_SIDE), (HALF_SIDE, HALF_SIDE), floor)
    plus = rectangle((-18.0, -45.0, low), (0.0, 90.0, 0.0), (-LEAN[0], 0.0, LEAN[1]))
    minus = rectangle((18.0, 45.0, low), (0.0, -90.0, 0.0), (LEAN[0], 0.0, LEAN[1]))
    seed = 10 * options.seed
    return Stage(
        pieces=(
            Piece("bottom", bottom, ImageTexture(gravel((2048, 2048), seed)), is_plane=True),
            Piece("slant_plus30", plus, ImageTexture(beans((1024, 1229), seed + 1)), is_plane=True),
            Piece("slant_minus30", minus, ImageTexture(grass((1024, 1229), seed + 2)), is_plane=True),
        ),
        rotation=look_at(center, target, rolls(options.images, 4.5)),
        center=center,
        length_unit="cm",
    )
