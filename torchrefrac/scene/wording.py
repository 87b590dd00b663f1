"""What figures, tables and sentences call the first surface that photographs look through, and what counts from it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from torchrefrac.scene.interfaces import PORT, SURFACE, WALL, Kind
from torchrefrac.scene.scene import Scene

INTERFACE = "interface"
"""The metric that says what a run looked through, where that is no surface of water."""


@dataclass(frozen=True)
class Wording:
    """Of one kind of interface, without units.

    The plane z = 0: surface, what it is, empty where it is nothing that could be drawn; line: the same in a section;
    glass: in a sentence; mover: what bends rays there; level: where it ends; above, below: on either side of it or of
    something else; within: what points beyond it are.

    z: height, what it is; z: the same for short; value: in a sentence; heights: several of them; relief: what sections
    show of it; ends: what dark and light colours of it are; depth: what a map of -z is called, empty where it has to be
    one of z; dark: what dark colours of that are.

    Views: across, up: the axes of one from the side; along_z: where one along z looks from, and y: its axis that points
    up there; off_axis: the angle between z and where a camera looks; dips: what roll and pitch are, tilted: what an
    offset of theirs says.

    incidence: the angle at which a ray meets the first surface, straight: what it is at 0. ground: what is
    reconstructed, flat: what of it should be flat. taken: how photographs were, unlike: what is suspicious of them.
    model: where there is refraction; poses: how they are found; check: what else may be wrong where an index ratio
    seems to be; scale: what it follows from. quantities: what is called otherwise than of water.
    """

    kind: Kind = SURFACE
    surface: str = "water surface"
    line: str = "the level of the water"
    height: str = "height above the water"
    z: str = "height"
    value: str = "height"
    heights: str = "heights"
    across: str = "horizontal"
    up: str = "height"
    y: str = "y"
    along_z: str = "from above"
    off_axis: str = "off vertical"
    above: str = "above"
    below: str = "below"
    relief: str = "heights"
    ends: str = "dark the deepest, light the highest"
    depth: str = "Depth below the water surface"
    dark: str = "depth: dark is deep"
    incidence: str = "angle of incidence on the water"
    straight: str = "straight down"
    glass: str = "the water"
    mover: str = "the water"
    level: str = "its level"
    within: str = "below the water"
    ground: str = "bed"
    flat: str = "flat ground"
    taken: str = "flown or walked"
    unlike: str = "heights and angles that are not what you flew"
    dips: str = (
        "by how much the right and the lower side of the photograph dip below the horizontal (both 0 when looking "
        "straight down)"
    )
    tilted: str = "that the water was not level in the IMU's eyes"
    model: str = "at the water surface"
    poses: str = "with known vertical"
    check: str = "check intrinsics and gravity"
    scale: str = (
        "Scale never follows from photographs alone: it comes from what was measured, such as a height, positions or "
        "lengths."
    )
    quantities: Mapping[str, str] | None = None

    @property
    def is_wall(self) -> bool:
        """Whether z = 0 stands upright, so that a view from the side shows z from left to right."""
        return self.kind == WALL

    def of_quantity(self, sentence: str) -> str:
        """A sentence that begins with what a quantity of the water is called, about that of this kind."""
        for of_water, own in (self.quantities or {}).items():
            if sentence.startswith(of_water):
                return own + sentence.removeprefix(of_water)
        return sentence


OF_WATER = Wording()
_WALL = Wording(
    kind=WALL,
    surface="glass",
    line="the glass",
    height="distance from the glass",
    z="before the glass",
    value="distance from the glass",
    heights="distances from the glass",
    across="before the glass",
    up="y",
    along_z="from the front",
    off_axis="off the normal of the glass",
    above="before",
    below="behind",
    relief="depths",
    ends="dark the farthest, light the nearest",
    depth="Depth behind the glass",
    incidence="angle of incidence on the glass",
    straight="straight at it",
    glass="the glass",
    mover="the wall",
    level="the glass",
    ground="scene",
    within="behind the glass",
    flat="a flat wall at the back",
    taken="walked",
    unlike="distances and angles that are not what you remember",
    dips="by how much the right and the lower side of the photograph lean towards the glass (both 0 when looking "
    "straight at it)",
    tilted="that the glass is not upright in the IMU's eyes",
    model="at the wall of glass",
    poses="in the frame of the wall, whose normal was found by refraction",
    check="check the glass (thickness and index), the distances from it, and intrinsics",
    scale="Scale follows from the thickness of the glass alone, and weakly: better from a measured distance from the "
    "glass, or lengths.",
    quantities={
        "tilt of the water to the cameras": "tilt of the glass to the cameras",
        "height of cameras above the water": "distance of cameras from the glass",
    },
)
_UPRIGHT_WALL = replace(
    _WALL,
    up="up",
    y="y, up",
    dips="by how much the right side of the photograph and the optical axis dip below the horizontal (both 0 when held "
    "level)",
)
_PORT = Wording(
    kind=PORT,
    surface="",
    line="",
    height="z",
    z="z",
    value="z",
    heights="z",
    relief="z",
    ends="dark the farthest, light the nearest",
    across="x",
    up="z",
    along_z="along the mean line of sight",
    off_axis="off the mean line of sight",
    depth="",
    dark="z: dark is far",
    incidence="angle of incidence on the port",
    straight="straight through it",
    glass="the port",
    mover="the port",
    ground="scene",
    within="before the port",
    taken="swum",
    unlike="angles that are not what you remember",
    tilted="that the IMU is turned against the camera",
    model="at the port of the housing",
    poses="from the pinhole that fits the rays behind the port best",
    check="check the port (distance, tilt and glass) and intrinsics",
    scale="Scale follows from the distance and the glass of the port alone, and next to not at all: measure lengths or "
    "positions.",
    quantities={
        "tilt of the water to the cameras": "tilt of the port",
        "height of cameras above the water": "distance of the port",
    },
)
_UPRIGHT_PORT = replace(
    _PORT,
    height="height",
    z="height",
    value="height",
    heights="heights",
    relief="heights",
    ends="dark the lowest, light the highest",
    across="horizontal",
    up="height",
    along_z="from above",
    off_axis="off vertical",
    dark="height: dark is low",
)


def wording(kind: Kind, upright: bool = False) -> Wording:
    """Of a kind of interface. upright: whether the frame shows which way is up, as it always does above water."""
    if kind == SURFACE:
        return OF_WATER
    if kind == WALL:
        return _UPRIGHT_WALL if upright else _WALL
    return _UPRIGHT_PORT if upright else _PORT


def wording_of(scene: Scene, metrics: Mapping[str, Any], upright: bool = False) -> Wording:
    """Of a scene, from the metrics of its run, which know what was looked through where it was reconstructed without.
    upright: whether it stands in a frame that shows which way is up, whatever the metrics say of gravity."""
    words = wording(metrics.get(INTERFACE, kind_of(scene)), upright or metrics.get("gravity") == "measured")
    return words if scene.interfaces.has_layers else replace(words, scale=OF_WATER.scale)


def kind_of(scene: Scene) -> Kind:
    """What the views of a scene look through: as its capture says, if it was reconstructed without refraction."""
    own = scene.interfaces.kinds[0]
    return own if scene.capture is None or own != SURFACE else scene.capture.interfaces.kinds[0]
