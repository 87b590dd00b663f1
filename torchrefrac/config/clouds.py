"""The typed options of the commands that hand results over: correct the cloud of another program, export cameras,
triangulate tracks."""

from dataclasses import dataclass, field
from typing import Literal

from torchrefrac.checks import Range, require_ranges
from torchrefrac.config.build import OptionError
from torchrefrac.config.options import DenseOutputs
from torchrefrac.correction import CorrectionRules
from torchrefrac.sfm.rules import MAX_ERROR

TRAINING_SETS = ("nerfstudio", "gsplat")
"""Forms of export that have the photographs beside the cameras."""
ANY_HEIGHT = Range(at_least=-1e9, at_most=1e9)


@dataclass(frozen=True)
class SurfaceOptions:
    """Where the water stands in the frame of a cloud: level, a height; or surface, path of a GeoTIFF or of a mesh."""

    level: float | None = None
    surface: str | None = None

    def __post_init__(self) -> None:
        require_ranges(self, {"level": ANY_HEIGHT})


@dataclass(frozen=True, kw_only=True)
class CorrectOptions(CorrectionRules):
    """A cloud that was made without refraction, its cameras, the water, and the folder for the results.

    camera: path of a camera.json, or focal_px and size (width, height) instead: of photographs whose table does not
    say it. crs: what cameras on Earth are put into, by default the system of the cloud. forecast: whether the error
    that is left is estimated. quiet: only errors are said.
    """

    cloud: str
    cameras: str
    out: str
    water: SurfaceOptions = field(default_factory=SurfaceOptions)
    camera: str | None = None
    focal_px: float | None = None
    size: tuple[int, ...] | None = None
    crs: str | None = None
    forecast: bool = True
    quiet: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_ranges(self, {"focal_px": Range(above=0.0, at_most=1e7), "size": Range(at_least=1, at_most=1_000_000)})
        for name in ("cloud", "cameras", "out"):
            if not getattr(self, name).strip():
                raise OptionError(f"{name} is empty, but must be a path")
        if (self.focal_px is None) != (self.size is None):
            raise OptionError("focal_px and size must be given together: the focal length and [width, height] in px")
        if self.camera is not None and self.focal_px is not None:
            raise OptionError("camera and focal_px are both given, but a calibrated camera has a focal length")
        if self.size is not None and len(self.size) != 2:
            raise OptionError(f"size is {list(self.size)}, but must be [width, height]")
        if (self.water.level is None) == (self.water.surface is None):
            found = "are both missing" if self.water.level is None else "are both given"
            raise OptionError(f"water.level and water.surface {found}, but one must say how high the water stands")


@dataclass(frozen=True)
class ExportOptions:
    """The folder of a run, or of an adjustment, and the form in which its cameras, or the products of its dense surface
    ("survey"), are written into a folder. outputs: which products. capture: folder of the photographs, of which an
    orthophoto is made, and which "nerfstudio" and "gsplat" need; by default the one that the run names. quiet: only
    errors are said."""

    run: str
    out: str
    format: Literal["colmap", "opk", "csv", "survey", "nerfstudio", "gsplat"] = "colmap"
    outputs: DenseOutputs = field(default_factory=DenseOutputs)
    capture: str | None = None
    quiet: bool = False

    def __post_init__(self) -> None:
        for name in ("run", "out"):
            if not getattr(self, name).strip():
                raise OptionError(f"{name} is empty, but must be a folder")


@dataclass(frozen=True)
class TriangulateOptions:
    """The folder of a run, or of an adjustment, and a CSV file of tracks (frame, id, view, x, y) that its cameras see.

    out: folder for the points; None: FILE_3d beside FILE.csv. pixel_origin: where pixels count from: the centre of the
    top-left one (OpenCV) or its corner (COLMAP). pixel_sigma: noise of a coordinate, px. max_error: of an observation
    that counts, px. quiet: only errors are said.
    """

    run: str
    tracks: str
    out: str | None = None
    pixel_origin: Literal["center", "corner"] = "center"
    pixel_sigma: float = 0.3
    max_error: float = 4.0
    quiet: bool = False

    def __post_init__(self) -> None:
        require_ranges(self, {"pixel_sigma": MAX_ERROR, "max_error": MAX_ERROR})
        for name, kind in (("run", "folder"), ("tracks", "file"), ("out", "folder")):
            if getattr(self, name) is not None and not getattr(self, name).strip():
                raise OptionError(f"{name} is empty, but must be a {kind}")
