"""The typed options of the commands."""

import math
from dataclasses import dataclass, field
from typing import Literal

from torchrefrac.checks import Range, require_ranges
from torchrefrac.config.build import OptionError
from torchrefrac.config.scenes import FolderOptions
from torchrefrac.dense import DenseOptions
from torchrefrac.features import Extractor, MadeElsewhereOptions, MatchOptions, NetworkOptions, SiftOptions
from torchrefrac.files.geotiff import require_geotiff
from torchrefrac.files.las import require_las
from torchrefrac.numerics import AUTO, device_of
from torchrefrac.parallel import ExecutorOptions
from torchrefrac.refraction import water_index
from torchrefrac.scene.interfaces import MAX_INDEX_RATIO
from torchrefrac.sfm import ReadjustOptions, SfmOptions
from torchrefrac.synthetic.options import SyntheticOptions

ModelName = Literal["none", "radial", "bundler", "refractive"]
FRESH_WATER = 1.333
SALINITY_PSU, WAVELENGTH_NM = Range(at_least=0.0, at_most=35.0), Range(at_least=400.0, at_most=700.0)
SEED = Range(at_least=0, at_most=2**64 - 1)  # what PyTorch takes
LEVEL = (0.0, 0.0, 1.0)  # normal of a water surface where z is up
FARTHEST = 1e9  # of a plane from the origin, in any unit


@dataclass(frozen=True)
class ModelOptions:
    """none: no refraction, lens fixed. radial: no refraction, k1 and k2 refined. bundler: no refraction, focal length,
    k1 and k2 of each photograph refined, from its EXIF alone. refractive: the water, exactly."""

    name: ModelName = "refractive"


@dataclass(frozen=True)
class WaterOptions:
    """index_ratio n_water / n_air, or the water's temperature to compute it from; neither takes that of the capture.

    temperature_c 0 to 30 degrees Celsius, salinity_psu 0 to 35 g/kg, wavelength_nm 400 to 700 (see `water_index`).
    """

    index_ratio: float | None = None
    temperature_c: float | None = None
    salinity_psu: float = 0.0
    wavelength_nm: float = 550.0

    def __post_init__(self) -> None:
        if self.index_ratio is not None and self.temperature_c is not None:
            raise OptionError("water.index_ratio and water.temperature_c are both given, but one decides the other")
        if self.temperature_c is not None:
            try:
                water_index(self.temperature_c, self.salinity_psu, self.wavelength_nm)
            except ValueError as error:
                raise OptionError(f"water.{error}") from None
        _require_index_ratio(self.index_ratio, "water.index_ratio")
        require_ranges(self, {"salinity_psu": SALINITY_PSU, "wavelength_nm": WAVELENGTH_NM})

    def ratio_of(self, capture_ratio: float) -> float:
        """The index ratio to use for a capture that states `capture_ratio`."""
        if self.temperature_c is not None:
            return float(water_index(self.temperature_c, self.salinity_psu, self.wavelength_nm))
        return capture_ratio if self.index_ratio is None else self.index_ratio


@dataclass(frozen=True)
class DenseOutputs:
    """Files that the dense stage writes besides dense.ply and its pictures.

    mesh: the surface as triangles; raster: heights on a grid, seen from above, in cells of raster_cell length units
    (None: by the spacing of the points); depth_maps: what each image sees.

    For geographic information systems, on the map where the capture says where its frame stands, else in that frame:
    geotiff: rasters of height, depth, uncertainty, views and relief; orthophoto: the surface in colour, with them; laz:
    dense and sparse points; contours: lines of equal depth, so far apart in length units (None: no such). crs: the
    reference system that they must be in (None: that of the capture's positions).

    Raises ValueError for a raster_cell or contours that are no length, and where what writes these files is missing or
    does not know `crs`.
    """

    mesh: bool = True
    raster: bool = True
    raster_cell: float | None = None
    depth_maps: bool = True
    geotiff: bool = False
    orthophoto: bool = True
    laz: bool = False
    contours: float | None = None
    crs: str | None = None

    @property
    def for_surveys(self) -> bool:
        """Whether something is written for geographic information systems."""
        return self.geotiff or self.laz or self.contours is not None

    @property
    def needs_raster(self) -> bool:
        """Whether something is made from heights on a grid in the frame of the scene."""
        return self.mesh or self.raster

    def __post_init__(self) -> None:
        length = Range(above=0.0, at_most=1e9)
        require_ranges(self, {"raster_cell": length, "contours": length})
        if self.crs is not None and not self.for_surveys:
            raise ValueError(f"crs is {self.crs!r}, but no file has one: set geotiff or laz to true")
        for name, require in (("geotiff", lambda: require_geotiff(self.crs)), ("laz", lambda: require_las(self.crs))):
            try:
                if getattr(self, name):
                    require()
            except ImportError as error:
                raise ValueError(f"{name} is true, but {error}") from None


@dataclass(frozen=True)
class Options:
    """Everything that decides how a capture is reconstructed, and what is written of its dense surface.

    survey: path of a survey.json, a gcp_list.txt or a table of control points; None: the survey.json beside the
    capture.json, if there is one. compare_land: whether the photographs are reconstructed without refraction, too, to
    say how far land differs. colmap: whether the run writes its scene as a COLMAP model, too. features: how keypoints
    are found, or an `Extractor` of one's own. device: where networks find them and descriptors are matched, see
    `device_of`; `sfm` and `dense` have their own.

    Raises OptionError for values that cannot be right, and for products of a dense surface where none is asked for.
    """

    model: ModelOptions = field(default_factory=ModelOptions)
    water: WaterOptions = field(default_factory=WaterOptions)
    features: SiftOptions | NetworkOptions | MadeElsewhereOptions | Extractor = field(default_factory=SiftOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    sfm: SfmOptions = field(default_factory=SfmOptions)
    dense: DenseOptions = field(default_factory=DenseOptions)
    outputs: DenseOutputs = field(default_factory=DenseOutputs)
    executor: ExecutorOptions = field(default_factory=ExecutorOptions)
    survey: str | None = None
    compare_land: bool = False
    colmap: bool = False
    device: str = AUTO
    seed: int = 0

    def __post_init__(self) -> None:
        require_ranges(self, {"seed": SEED})
        device_of(self.device)
        trained_on = f"kornia_{self.matching.trained_on}"
        if self.matching.matcher == "lightglue" and getattr(self.features, "method", trained_on) != trained_on:
            raise OptionError(
                f"matching.matcher is 'lightglue', trained on {trained_on}, but features.method is "
                f"{getattr(self.features, 'method', '')!r}: set features={trained_on}, or matching.trained_on"
            )
        if self.outputs.for_surveys and self.dense.method == "none":
            raise OptionError(
                "dense.method is 'none', but outputs.geotiff, laz and contours are made of the dense surface: set "
                "dense=patch, or make the run dense later"
            )


@dataclass(frozen=True)
class OutputOptions:
    """out: folder for the results. cache: folder where made scenes are kept, by default the user's cache. quiet: only
    errors are said. report: whether report.html is written. objective: the metric that a sweeper which optimises makes
    small, by default the error of the cameras where the truth is known, else that of reprojection."""

    out: str
    cache: str | None = None
    quiet: bool = False
    report: bool = True
    objective: str | None = None

    def __post_init__(self) -> None:
        _require_out(self.out)


@dataclass(frozen=True)
class RunOptions:
    """A run from the command line: a scene, how to reconstruct it, and where the results go."""

    scene: FolderOptions | SyntheticOptions
    reconstruction: Options
    output: OutputOptions


@dataclass(frozen=True)
class DensifyOptions:
    """A run folder from the command line, how to make it dense, and what to write.

    capture: folder of the photographs, by default the one that the run's metrics.json names. frames: a pattern of
    folders, each with photographs that the cameras of the run have taken at another moment; out: where their results
    go, a folder each. device: by default that of `dense`. quiet, report: as in `OutputOptions`.
    """

    run: str
    capture: str | None = None
    frames: str | None = None
    out: str | None = None
    executor: ExecutorOptions = field(default_factory=ExecutorOptions)
    device: str = AUTO
    dense: DenseOptions = field(default_factory=lambda: DenseOptions(method="patch"))
    outputs: DenseOutputs = field(default_factory=DenseOutputs)
    quiet: bool = False
    report: bool = True

    def __post_init__(self) -> None:
        if self.dense.method == "none":
            raise OptionError("dense.method is 'none', but must be patch or depthmap: none leaves the run as it is")
        if (self.frames is None) != (self.out is None):
            missing = "frames" if self.frames is None else "out"
            raise OptionError(f"{missing} is missing: frames are the folders of photographs, out that of their results")


@dataclass(frozen=True)
class PlaneOptions:
    """The water plane normal . x = offset in the frame of an alignment, its normal out of the water. offset "find": the
    height of the water is searched for and then varies; normal "find": so are its tilts."""

    normal: tuple[float, ...] | Literal["find"] = LEVEL
    offset: float | Literal["find"] = 0.0

    def __post_init__(self) -> None:
        if self.normal != "find" and (len(self.normal) != 3 or not 0.0 < math.hypot(*self.normal) < math.inf):
            wanted = "three numbers, not all zero, or find"
            raise OptionError(f"plane.normal is {list(self.normal)}, but must be {wanted}")
        if self.offset != "find" and not abs(self.offset) <= FARTHEST:
            raise OptionError(f"plane.offset is {self.offset}, but must be finite, or find, and {FARTHEST:g} at most")

    @property
    def is_level(self) -> bool:
        """Whether nothing is said of a tilt or a height."""
        return self.normal in (LEVEL, "find") and self.offset in (0.0, "find")

    @property
    def refined(self) -> tuple[Literal["plane_tilt", "plane_height"], ...]:
        """What varies of it."""
        return (("plane_tilt",) if self.normal == "find" else ()) + (("plane_height",) if self.offset == "find" else ())


@dataclass(frozen=True)
class WaterFileOptions:
    """path of a water.json."""

    path: str | None = None


@dataclass(frozen=True, kw_only=True)
class AdjustOptions(ReadjustOptions):
    """An alignment from the command line, how to adjust it anew, and the folder for the results.

    alignment: folder of a COLMAP model or of a run. plane: where the water is without a water.json. index_ratio: by
    default that of the water.json, of the run, or of fresh water. survey: path of a survey.json. truth: folder of a
    truth.json, by default that of the alignment, or of the photographs of the run. format: of the COLMAP model that is
    written. quiet, report: as in `OutputOptions`.
    """

    alignment: str
    out: str
    water: WaterFileOptions = field(default_factory=WaterFileOptions)
    index_ratio: float | None = None
    plane: PlaneOptions = field(default_factory=PlaneOptions)
    survey: str | None = None
    truth: str | None = None
    format: Literal["text", "binary"] = "text"
    quiet: bool = False
    report: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_out(self.out)
        _require_index_ratio(self.index_ratio, "index_ratio")
        if self.water.path is not None and self.plane != PlaneOptions():
            raise OptionError("water.path and plane are both given, but a water.json says where the planes are")


def _require_out(out: str) -> None:
    if not out.strip():
        raise OptionError("out is empty, but must be the folder for the results")


def _require_index_ratio(ratio: float | None, path: str) -> None:
    if ratio is not None and not 1.0 <= ratio <= MAX_INDEX_RATIO:
        raise OptionError(f"{path} is {ratio:g}, but must lie between 1 and {MAX_INDEX_RATIO:g} (water: 1.333)")
