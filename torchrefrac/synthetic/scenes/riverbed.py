"""A river's bed with boulders and a dry bank, photographed from a drone. Lengths in m."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import require, require_between
from torchrefrac.synthetic.options import LONGEST, MAX_IMAGES, InterfaceOptions, SyntheticOptions
from torchrefrac.synthetic.paths import grid, look_at, ring, rolls
from torchrefrac.synthetic.scenes.ground import bed, boulders, cells, colours, height_field, with_boulders
from torchrefrac.synthetic.stage import Piece, Stage
from torchrefrac.synthetic.textures import ImageTexture

NODE, TEXEL = 1 / 275, 1 / 1000  # of the height field and of its texture, in heights of the drone
OBLIQUE_DEG, SWAY_DEG = 30.0, 2.0


@dataclass(frozen=True, kw_only=True)
class RiverbedOptions(SyntheticOptions):
    """Greatest depth of the water; a drone at `altitude` above it takes columns x rows photographs that look straight
    down and overlap by `overlap` (of their sides), and `obliques` from around that look at the middle.

    position_sigma: of a coordinate of the satellite positions; None: there are none. boulders: how many stand on the
    bed. All in m. The ground reaches as far as the photographs that look straight down.
    """

    depth: float = 3.0
    altitude: float = 25.0
    columns: int = 4
    rows: int = 4
    overlap: float = 0.75
    obliques: int = 6
    boulders: int = 240
    position_sigma: float | None = 0.03
    interface: InterfaceOptions = field(default_factory=InterfaceOptions.in_metres)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.depth, "depth", at_least=0.1)
        require(self.altitude, "altitude", at_least=2.0, at_most=500.0)
        if self.depth > self.altitude:
            raise ValueError(f"depth is {self.depth:g}, but must be at most the drone's altitude of {self.altitude:g}")
        for name in ("columns", "rows"):
            require_between(getattr(self, name), name, 1, 20)
        if self.columns * self.rows < 2:
            raise ValueError("columns and rows are both 1, but must be two photographs or more together")
        require(self.overlap, "overlap", at_least=0.3, at_most=0.95)
        for name, most in (("obliques", MAX_IMAGES), ("boulders", 5000)):
            require_between(getattr(self, name), name, 0, most)
        if self.position_sigma is not None:
            require(self.position_sigma, "position_sigma", above=0.0, at_most=LONGEST)

    @property
    def view(self) -> tuple[float, float]:
        """Width and height of what a photograph shows of the water surface."""
        wide = self.altitude * self.camera.width / self.camera.focal
        return wide, wide * self.camera.height / self.camera.width

    @property
    def half_size(self) -> tuple[float, float]:
        """Of the ground, from the middle: more than what is seen from straight above, with some sway."""
        flown = ((n - 1) * (1.0 - self.overlap) for n in (self.columns, self.rows))
        beyond, sway = 1.0 + self.depth / self.altitude, 2.0 * math.radians(SWAY_DEG) * self.altitude
        across, along = (0.5 * side * (steps + beyond) + sway for side, steps in zip(self.view, flown, strict=True))
        return across, along


def riverbed_stage(options: RiverbedOptions) -> Stage:
    """The river under the sun."""
    rng = np.random.default_rng(options.seed)
    half = options.half_size
    size = cells(half, NODE * options.altitude)
    stones = boulders(half, options.boulders, rng)
    smooth = bed(size, half, options.depth, rng)
    height = with_boulders(smooth, half, stones, rng)
    rocky = height > smooth
    height[height < 0.0] *= options.depth / -min(float(height.min()), -1e-3)
    image = colours(cells(half, TEXEL * options.altitude), half, height, rocky, stones, options.seed)
    rotation, center = _flight(options)
    return Stage(
        pieces=(Piece("riverbed", height_field(height, half), ImageTexture(image)),),
        rotation=rotation,
        center=center,
        length_unit="m",
        towards_light=(-0.45, 0.55, 0.8),
        ambient=0.6,
        direct=0.5,
        position_sigma=options.position_sigma,
    )


def _flight(options: RiverbedOptions) -> tuple[Float[Tensor, "m 3 3"], Float[Tensor, "m 3"]]:
    spacing = tuple((1.0 - options.overlap) * side for side in options.view)
    down = grid(options.columns, options.rows, (spacing[0], spacing[1]), options.altitude)
    sway = rolls(len(down), SWAY_DEG)
    below = down + options.altitude * torch.stack((sway.sin(), sway.roll(3).sin(), -torch.ones_like(sway)), dim=-1)
    straight = look_at(down, below, rolls(len(down), 3.0), up=(0.0, 1.0, 0.0))
    radius = options.altitude * math.tan(math.radians(OBLIQUE_DEG))
    around = ring(options.obliques, radius, [options.altitude], (10.0, 370.0))
    slanted = look_at(around, torch.zeros_like(around), rolls(len(around), 2.0))
    return torch.cat((straight, slanted)), torch.cat((down, around))
