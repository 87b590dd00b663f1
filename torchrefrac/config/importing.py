"""The typed options of the commands that come before a reconstruction: import and calibrate."""

import re
from dataclasses import dataclass
from typing import Literal

from torchrefrac.bundle.options import Unknown
from torchrefrac.checks import Range, require, require_ranges
from torchrefrac.config.build import OptionError
from torchrefrac.scene.interfaces import MAX_INDEX_RATIO

ANY_ALTITUDE = Range(at_least=-1e5, at_most=1e6)  # m
UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}  # m
LENGTH = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*([a-z]+)\s*")
ANY_SIDE = Range(above=0.0, at_most=1e6)
NEEDED = {
    "none": (), "charuco": ("columns", "rows", "square"), "chessboard": ("columns", "rows", "square"),
    "apriltag": ("tag",),
}  # fmt: skip
"""Options without which a board is none."""


@dataclass(frozen=True)
class FilmOptions:
    """Of the frames that are taken from a film: overlap, by how much of their sides neighbours show the same; most, how
    many are taken."""

    overlap: float = 0.8
    most: int = 300

    def __post_init__(self) -> None:
        require_ranges(self, {"overlap": Range(at_least=0.1, at_most=0.98), "most": Range(at_least=2, at_most=10_000)})


@dataclass(frozen=True, kw_only=True)
class BoardOptions:
    """A flat board, as it is photographed.

    board: of which kind. columns, rows: squares of a charuco board, inner corners of a chessboard. square, marker:
    sides, numbers or texts with a unit. dictionary: of the markers, by OpenCV's name.
    """

    board: Literal["none", "charuco", "chessboard", "apriltag"] = "charuco"
    columns: int | None = None
    rows: int | None = None
    square: float | str | None = None
    marker: float | str | None = None
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        needed = NEEDED[self.board]
        missing = [name for name in needed if getattr(self, name) is None]
        if missing:
            raise OptionError(f"{missing[0]} is missing, but board={self.board} needs {', '.join(needed)}")
        side = Range(at_least=3 if self.board == "chessboard" else 2, at_most=100)
        require_ranges(self, {"columns": side, "rows": side})
        square, marker = self.side("square"), self.side("marker")
        if square is not None and marker is not None and marker >= square:
            shown = [side if isinstance(side, str) else f"{side:g}" for side in (self.marker, self.square) if side]
            raise OptionError(f"marker is {shown[0]}, but must be smaller than the square of {shown[1]}")

    def side(self, name: str) -> float | None:
        """An option that is a length, in m where it has a unit."""
        return length_in_m(name, getattr(self, name))


def length_in_m(name: str, value: float | str | None) -> float | None:
    """A length with a unit, such as 30mm, in m; a number as it is, and None where nothing is given."""
    if value is None:
        return None
    if isinstance(value, str):
        found = LENGTH.fullmatch(value)
        if found is None or found[2] not in UNITS:
            raise OptionError(
                f"{name} is {value!r}, but must be a number with a unit ({', '.join(UNITS)}), such as 30mm"
            )
        value = float(found[1]) * UNITS[found[2]]
    require(value, name, **ANY_SIDE._asdict())
    return value


@dataclass(frozen=True, kw_only=True)
class ImportOptions(BoardOptions):
    """Photographs from the command line, what is known of them beside what their files say, and where capture.json
    goes.

    photographs: folders, files, patterns, or a film. table: a CSV file, or a geo.txt. crs: of positions, by default the
    zone of UTM. vertical: what altitudes count from, by default what those of most photographs do. epoch_gap_hours:
    after which without photographs the water may stand at another level; None: it did not. water_level: the water's
    altitude; take_off_above_water: height of the place of the take-off. cameras: what tells cameras apart.
    camera: a file written by `torchrefrac calibrate`. focal_px: of all photographs. gravity_sigma_deg, position_sigma
    (horizontal, vertical; m), focal_sigma (relative): instead of those by the makers of the devices. look: whether
    photographs are looked at, and useless ones left out. board and what goes with it: what lies in the scene and gives
    its scale, if anything; family and tag: of tags, with the side of their black square; board_sigma: of lengths on it,
    relative. quiet: only errors are said.

    Raises OptionError for values that cannot be right, contradict each other, or lack a unit.
    """

    photos: str | tuple[str, ...]
    out: str
    table: str | None = None
    index_ratio: float = 1.333
    epoch_gap_hours: float | None = None
    crs: str | None = None
    vertical: Literal["auto", "ellipsoid", "sea_level", "take_off", "table"] = "auto"
    water_level: float | None = None
    take_off_above_water: float | None = None
    cameras: Literal["model", "folder"] = "model"
    camera: str | None = None
    focal_px: float | None = None
    gravity_sigma_deg: float | None = None
    position_sigma: tuple[float, ...] | None = None
    focal_sigma: float | None = None
    look: bool = True
    film: FilmOptions = FilmOptions()
    board: Literal["none", "charuco", "chessboard", "apriltag"] = "none"
    family: str = "tag36h11"
    tag: float | str | None = None
    board_sigma: float = 0.002
    quiet: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_units()
        if not self.out.strip():
            raise OptionError("out is empty, but must be the folder for capture.json")
        if not self.sources or not all(source.strip() for source in self.sources):
            raise OptionError("photos is empty, but must be a folder of photographs, or several, or a film")
        if not 1.0 <= self.index_ratio <= MAX_INDEX_RATIO:
            wanted = f"must lie between 1 and {MAX_INDEX_RATIO:g} (water: 1.333)"
            raise OptionError(f"index_ratio is {self.index_ratio:g}, but {wanted}")
        if self.position_sigma is not None and len(self.position_sigma) != 2:
            raise OptionError(
                f"position_sigma is {list(self.position_sigma)}, but must be two: horizontal and vertical"
            )
        if self.water_level is not None and self.take_off_above_water is not None:
            raise OptionError("water_level and take_off_above_water are both given, but one decides the other")
        if self.camera is not None and self.focal_px is not None:
            raise OptionError("camera and focal_px are both given, but a calibrated camera has a focal length")
        require_ranges(
            self,
            {
                "epoch_gap_hours": Range(above=0.0, at_most=1e6),
                "water_level": ANY_ALTITUDE,
                "take_off_above_water": ANY_ALTITUDE,
                "focal_px": Range(above=0.0, at_most=1e7),
                "gravity_sigma_deg": Range(above=0.0, at_most=30.0),
                "position_sigma": Range(above=0.0, at_most=1e6),
                "focal_sigma": Range(above=0.0, at_most=1.0),
                "board_sigma": Range(above=0.0, at_most=1.0),
            },
        )

    @property
    def sources(self) -> tuple[str, ...]:
        """Every folder, file or pattern."""
        return (self.photos,) if isinstance(self.photos, str) else self.photos

    def _require_units(self) -> None:
        """Of what gives the scene its scale."""
        for name in ("square", "marker", "tag"):
            value = getattr(self, name)
            length_in_m(name, value)
            if value is not None and not isinstance(value, str):
                raise OptionError(f"{name} is {value:g}, but must have a unit, such as {value:g}mm")


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions(BoardOptions):
    """Photographs of a board from the command line, and what the board is like; its sides in any unit.

    capture: instead of photos, the folder of a capture.json, of which poses and whatever it states to be uncertain of
    cameras and interfaces is found, by a board or by `points`, a CSV file of known points and their pixels. refine:
    what varies besides that (see `BundleOptions`). pixel_sigma: expected noise of a corner or click, pixels. out: path
    of the file that is written, or of the folder where there is a capture. quiet: only errors are said.
    """

    photos: str | tuple[str, ...] = ()
    out: str
    board: Literal["charuco", "chessboard"] = "charuco"
    model: Literal["opencv", "rational", "fisheye"] = "opencv"
    capture: str | None = None
    points: str | None = None
    refine: tuple[Unknown, ...] = ()
    pixel_sigma: float = 0.3
    quiet: bool = False

    def __post_init__(self) -> None:
        if self.points is None:
            super().__post_init__()
        if not self.out.strip():
            raise OptionError("out is empty, but must be the path of the camera.json to write")
        if self.capture is None:
            self._check_photos()
        elif self.sources:
            raise OptionError("photos and capture are both given, but the photographs are those of the capture")
        require_ranges(self, {"pixel_sigma": Range(above=0.0, at_most=1e3)})

    def _check_photos(self) -> None:
        if not self.sources or not all(source.strip() for source in self.sources):
            raise OptionError("photos is empty, but must be a folder of photographs, or several")
        if self.points is not None or self.refine:
            name = "refine" if self.points is None else "points"
            raise OptionError(f"{name} is given without capture, the folder of the capture.json that it is about")

    @property
    def sources(self) -> tuple[str, ...]:
        """Every folder, file or pattern."""
        return (self.photos,) if isinstance(self.photos, str) else self.photos
