"""The typed options of a run, and how they are built from plain mappings. YAML is read elsewhere."""

import dataclasses
import math
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from torchrefrac.dense import DenseOptions
from torchrefrac.features import MatchOptions, SiftOptions
from torchrefrac.refraction import water_index
from torchrefrac.report.dense_outputs import DenseOutputs
from torchrefrac.scene.capture_file import MAX_INDEX_RATIO
from torchrefrac.sfm import SfmOptions
from torchrefrac.sfm.readjust import ReadjustOptions

T = TypeVar("T")
PLAIN = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
ModelName = Literal["none", "radial", "refractive"]
FRESH_WATER = 1.333


class OptionError(ValueError):
    """An option is unknown, missing or of the wrong type; the message names it."""


@dataclass(frozen=True)
class ModelOptions:
    """none: no refraction, lens fixed. radial: no refraction, k1 and k2 refined. refractive: the water, exactly."""

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

    def ratio_of(self, capture_ratio: float) -> float:
        """The index ratio to use for a capture that states `capture_ratio`."""
        if self.temperature_c is not None:
            return float(water_index(self.temperature_c, self.salinity_psu, self.wavelength_nm))
        return capture_ratio if self.index_ratio is None else self.index_ratio


@dataclass(frozen=True)
class Options:
    """Everything that decides how a capture is reconstructed, and what is written of its dense surface."""

    model: ModelOptions = field(default_factory=ModelOptions)
    water: WaterOptions = field(default_factory=WaterOptions)
    features: SiftOptions = field(default_factory=SiftOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    sfm: SfmOptions = field(default_factory=SfmOptions)
    dense: DenseOptions = field(default_factory=DenseOptions)
    outputs: DenseOutputs = field(default_factory=DenseOutputs)
    seed: int = 0


@dataclass(frozen=True)
class SceneOptions:
    """An embedded scene by name, or the capture in the folder `path`."""

    name: str
    path: str | None = None


@dataclass(frozen=True)
class RunOptions:
    """A run from the command line: a scene, how to reconstruct it, and the folder for the results."""

    scene: SceneOptions
    reconstruction: Options
    out: str


@dataclass(frozen=True)
class DensifyOptions:
    """A run folder from the command line, how to make it dense, and what to write.

    capture: folder of the photographs, by default the one that the run's metrics.json names.
    """

    run: str
    capture: str | None = None
    dense: DenseOptions = field(default_factory=lambda: DenseOptions(method="patch"))
    outputs: DenseOutputs = field(default_factory=DenseOutputs)

    def __post_init__(self) -> None:
        if self.dense.method == "none":
            raise OptionError("dense.method is 'none', but must be patch or depthmap: none leaves the run as it is")


@dataclass(frozen=True)
class PlaneOptions:
    """The water plane normal . x = offset in the frame of an alignment, its normal out of the water. offset "find": the
    height of the water is searched for and then varies."""

    normal: tuple[float, ...] = (0.0, 0.0, 1.0)
    offset: float | Literal["find"] = 0.0

    def __post_init__(self) -> None:
        if len(self.normal) != 3 or not 0.0 < math.hypot(*self.normal) < math.inf:
            raise OptionError(f"plane.normal is {list(self.normal)}, but must be three numbers, not all zero")
        if self.offset != "find" and not math.isfinite(self.offset):
            raise OptionError(f"plane.offset is {self.offset}, but must be finite, or find")


@dataclass(frozen=True)
class WaterFileOptions:
    """path of a water.json."""

    path: str | None = None


@dataclass(frozen=True, kw_only=True)
class AdjustOptions(ReadjustOptions):
    """An alignment from the command line, how to adjust it anew, and the folder for the results.

    alignment: folder of a COLMAP model or of a run. plane: where the water is without a water.json. index_ratio: by
    default that of the water.json, or of fresh water. survey: path of a survey.json. truth: folder of a truth.json, by
    default that of the alignment. format: of the COLMAP model that is written.
    """

    alignment: str
    out: str
    water: WaterFileOptions = field(default_factory=WaterFileOptions)
    index_ratio: float | None = None
    plane: PlaneOptions = field(default_factory=PlaneOptions)
    survey: str | None = None
    truth: str | None = None
    format: Literal["text", "binary"] = "text"

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_index_ratio(self.index_ratio, "index_ratio")
        if self.water.path is not None and self.plane != PlaneOptions():
            raise OptionError("water.path and plane are both given, but a water.json says where the planes are")


def build(cls: type[T], values: Mapping[str, Any], path: str = "") -> T:
    """An instance of the dataclass `cls` from nested plain values, strictly.

    Raises OptionError that names the option (dotted) for an unknown or missing one, or one of the wrong type. A whole
    number serves where a float is wanted.
    """
    hints = get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in values:
        if name not in fields:
            raise OptionError(f"{_join(path, name)} is not an option; known here are {', '.join(fields)}")
    arguments = {}
    for name, described in fields.items():
        if name in values:
            arguments[name] = _convert(hints[name], values[name], _join(path, name))
        elif described.default is dataclasses.MISSING and described.default_factory is dataclasses.MISSING:
            raise OptionError(f"{_join(path, name)} is missing")
    try:
        return cls(**arguments)
    except OptionError:
        raise
    except ValueError as error:  # from options of a layer that does not know how they are read
        raise OptionError(_join(path, str(error))) from None


def _convert(hint: Any, value: Any, path: str) -> Any:
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if not isinstance(value, Mapping):
            raise OptionError(f"{path} is {value!r}, but must be a group of options")
        return build(hint, value, path)
    origin = get_origin(hint)
    if origin is Literal:
        choices = get_args(hint)
        if value not in choices:
            raise OptionError(f"{path} is {value!r}, but must be one of {', '.join(map(str, choices))}")
        return value
    if origin in (Union, types.UnionType):
        return _convert_union(get_args(hint), value, path)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise OptionError(f"{path} is {value!r}, but must be a list")
        return tuple(_convert(get_args(hint)[0], item, f"{path}[{i}]") for i, item in enumerate(value))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not hint:
        raise OptionError(f"{path} is {value!r}, but must be {PLAIN[hint]}")
    return value


def _convert_union(choices: tuple[Any, ...], value: Any, path: str) -> Any:
    """One kind of value, or null or one of some words where these are among the choices."""
    words = [word for choice in choices if get_origin(choice) is Literal for word in get_args(choice)]
    if value in words or (value is None and type(None) in choices):
        return value
    kind = next(choice for choice in choices if choice is not type(None) and get_origin(choice) is not Literal)
    try:
        return _convert(kind, value, path)
    except OptionError as error:
        raise OptionError(", or ".join((str(error), *words))) from None


def _require_index_ratio(ratio: float | None, path: str) -> None:
    if ratio is not None and not 1.0 <= ratio <= MAX_INDEX_RATIO:
        raise OptionError(f"{path} is {ratio:g}, but must lie between 1 and {MAX_INDEX_RATIO:g} (water: 1.333)")


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
