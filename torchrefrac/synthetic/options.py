"""What decides how a made scene is photographed, down to its random numbers. What decides the scene itself stands with
each scene."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import torch

from torchrefrac.checks import Range, require, require_between, require_ranges
from torchrefrac.scene.interfaces import MAX_INDEX_RATIO

MAX_SAMPLES = 16
MAX_IMAGES = 500
LONGEST = 1e6  # of what a scene measures, in any unit
MAX_PORT_TILT_DEG = 30.0
MAX_SEED = 2**56  # a hundred times as much still fits into 64 bits


@dataclass(frozen=True, kw_only=True)
class WaveOptions:
    """Small waves on the water: `components` sines of random directions, phases and lengths up to `longest` (length
    units), the slopes of all together `rms_slope` (0: calm). moving: every photograph is of another moment, its phases
    drawn anew."""

    rms_slope: float = 0.0
    longest: float = 80.0
    components: int = 8
    moving: bool = False

    def __post_init__(self) -> None:
        require_between(self.rms_slope, "rms_slope", 0.0, 0.3)
        require(self.longest, "longest", above=0.0, at_most=LONGEST)
        require_between(self.components, "components", 1, 64)


@dataclass(frozen=True, kw_only=True)
class InterfaceOptions:
    """What photographs are taken through: a `surface` of water, z = 0; a `wall` of glass, whose dry face is z = 0; or a
    `port` of glass that moves with the camera, everything under water.

    glass_index relative to air, glass_thickness in the scene's unit: of walls and ports. distance: from a camera's
    centre to the dry face of its port along the normal, which is turned by tilt_deg about the camera's x and y.
    """

    kind: Literal["surface", "wall", "port"] = "surface"
    glass_index: float = 1.52
    glass_thickness: float = 1.2
    distance: float = 2.0
    tilt_deg: tuple[float, ...] = (0.0, 0.0)

    @classmethod
    def in_metres(cls) -> "InterfaceOptions":
        """A water surface, and the same glass for scenes in m."""
        return cls(glass_thickness=0.012, distance=0.02)

    def __post_init__(self) -> None:
        require_between(self.glass_index, "glass_index", 1.0, MAX_INDEX_RATIO, "(glass: 1.52)")
        require_ranges(self, {"glass_thickness": Range(at_least=0.0, at_most=LONGEST)})
        require_ranges(self, {"distance": Range(above=0.0, at_most=LONGEST)})
        if len(self.tilt_deg) != 2 or not all(abs(turn) <= MAX_PORT_TILT_DEG for turn in self.tilt_deg):
            wanted = f"two angles up to {MAX_PORT_TILT_DEG:g} degrees"
            raise ValueError(f"tilt_deg is {list(self.tilt_deg)}, but must be {wanted}")


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """width and height in pixels, horizontal field of view fov_deg, distortion (k1, k2, p1, p2, k3)."""

    width: int = 1024
    height: int = 768
    fov_deg: float = 75.0
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            require_between(getattr(self, name), name, 16, 20000, "pixels")
        require_between(self.fov_deg, "fov_deg", 1.0, 150.0, "degrees")
        if len(self.distortion) != 5 or not all(map(math.isfinite, self.distortion)):
            raise ValueError(f"distortion is {list(self.distortion)}, but must be five numbers: k1, k2, p1, p2, k3")
        require_ranges(self, {"distortion": Range(at_least=-1e6, at_most=1e6)})

    @property
    def focal(self) -> float:
        """In pixels."""
        return 0.5 * self.width / math.tan(math.radians(0.5 * self.fov_deg))


@dataclass(frozen=True, kw_only=True)
class HeldCameraOptions(CameraOptions):
    """A camera that is turned about its optical axis by so many quarter turns, which turn what it sees clockwise."""

    quarter_turns: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_between(self.quarter_turns, "quarter_turns", -3, 3)


@dataclass(frozen=True, kw_only=True)
class SensorOptions:
    """samples x samples rays a pixel; blur: standard deviation of the optics' spot (pixels), noise: of a grey value."""

    samples: int = 4
    blur: float = 0.4
    noise: float = 1.0

    def __post_init__(self) -> None:
        require_between(self.samples, "samples", 1, MAX_SAMPLES)
        require_ranges(self, {"blur": Range(at_least=0.0, at_most=100.0), "noise": Range(at_least=0.0, at_most=255.0)})


@dataclass(frozen=True, kw_only=True)
class InertialOptions:
    """Errors of what the camera says of its attitude.

    gravity_sigma_deg: standard deviation of the angle about each axis across the vertical, of each image's own (None:
    gravity is not measured); gravity_bias_deg: the same turn (about the camera's x and y axes) in all images, such as
    of a sensor that is mounted askew; heading_sigma_deg: of the compass heading (None: there is no compass).
    """

    gravity_sigma_deg: float | None = 0.5
    gravity_bias_deg: tuple[float, ...] = (0.0, 0.0)
    heading_sigma_deg: float | None = 5.0

    def __post_init__(self) -> None:
        if self.gravity_sigma_deg is not None:
            require_between(self.gravity_sigma_deg, "gravity_sigma_deg", 0.0, 30.0, "degrees")
        if len(self.gravity_bias_deg) != 2 or not all(abs(turn) <= 30.0 for turn in self.gravity_bias_deg):
            given = list(self.gravity_bias_deg)
            raise ValueError(f"gravity_bias_deg is {given}, but must be two angles up to 30 degrees")
        require_ranges(self, {"heading_sigma_deg": Range(at_least=0.0, at_most=180.0)})


@dataclass(frozen=True, kw_only=True)
class DroneOptions:
    """Errors of a drone that writes its own metadata: standard deviations of its positions, horizontal and vertical
    (m), and of its gimbal about each axis."""

    position_sigma: tuple[float, ...] = (0.02, 0.03)
    gimbal_sigma_deg: float = 0.3

    def __post_init__(self) -> None:
        if len(self.position_sigma) != 2:
            raise ValueError(f"position_sigma is {list(self.position_sigma)}, but must be two: horizontal and vertical")
        require_ranges(self, {"position_sigma": Range(above=0.0, at_most=LONGEST)})
        require_between(self.gimbal_sigma_deg, "gimbal_sigma_deg", 0.0, 30.0, "degrees")


@dataclass(frozen=True, kw_only=True)
class SyntheticOptions:
    """How any made scene is photographed.

    index_ratio: true n_water / n_air. cameras: those that take the photographs in turn; none: `camera` takes all, for
    which their path is made in any case. interface: what they are taken through. plane_tilt_deg: how far true gravity
    is, about world x and y, from the perpendicular of the water surface, as in a tank that is filled to a tilted lid,
    or from -y along a wall; the frame stays that of the surface or wall. reflection: grey value of the sky that the
    surface mirrors (0: it mirrors nothing). metadata: what the photographs say of themselves, nothing or what `drone`
    would. seed decides textures, waves, noise and all errors.
    """

    name: str
    index_ratio: float = 1.333
    plane_tilt_deg: tuple[float, ...] = (0.0, 0.0)
    reflection: float = 0.0
    camera: CameraOptions = field(default_factory=CameraOptions)
    cameras: tuple[HeldCameraOptions, ...] = ()
    interface: InterfaceOptions = field(default_factory=InterfaceOptions)
    sensor: SensorOptions = field(default_factory=SensorOptions)
    inertial: InertialOptions = field(default_factory=InertialOptions)
    waves: WaveOptions = field(default_factory=WaveOptions)
    metadata: Literal["none", "drone"] = "none"
    drone: DroneOptions = field(default_factory=DroneOptions)
    seed: int = 0

    @property
    def label(self) -> str:
        """What reports call the scene."""
        return self.name

    @property
    def at_surface(self) -> bool:
        """Whether photographs are taken through a water surface."""
        return self.interface.kind == "surface"

    def fingerprint(self) -> dict[str, Any]:
        """What decides the photographs, as plain values: all options, and the kind of scene."""
        options = asdict(self)
        if not self.cameras:
            del options["cameras"]
        if self.at_surface:
            del options["interface"]
        if self.metadata == "none":
            del options["metadata"], options["drone"]
        return {"scene": type(self).__name__, **options}

    def __post_init__(self) -> None:
        require_between(self.index_ratio, "index_ratio", 1.0, MAX_INDEX_RATIO, "(water: 1.333)")
        if len(self.plane_tilt_deg) != 2 or not all(abs(turn) <= 45.0 for turn in self.plane_tilt_deg):
            raise ValueError(f"plane_tilt_deg is {list(self.plane_tilt_deg)}, but must be two angles up to 45 degrees")
        require_between(self.reflection, "reflection", 0.0, 255.0)
        require_ranges(self, {"seed": Range(at_least=0, at_most=MAX_SEED)})
        of_water = {"waves.rms_slope": self.waves.rms_slope, "reflection": self.reflection}
        for name, value in of_water.items():
            if value > 0.0 and not self.at_surface:
                raise ValueError(f"{name} is {value:g}, but must be 0: interface.kind is {self.interface.kind}")
        if self.metadata == "drone" and not self.at_surface:
            raise ValueError(f"metadata is drone, but must be none: interface.kind is {self.interface.kind}")


def require_images(images: int) -> None:
    """Refuse too few photographs to reconstruct from, and more than anyone means to render."""
    require_between(images, "images", 2, MAX_IMAGES)


def require_heights(heights: Sequence[float]) -> None:
    """Refuse cameras that do not stand above the water."""
    if not heights:
        raise ValueError("heights is empty, but must be one or more heights above the water, taken in turn")
    for height in heights:
        require(height, "heights", above=0.0, at_most=LONGEST)


def seeded(seed: int, *purpose: str | int) -> torch.Generator:
    """A generator that depends on nothing but the seed and what it is for."""
    words = "/".join(str(word) for word in (seed, *purpose))
    number = int.from_bytes(hashlib.sha256(words.encode("utf-8")).digest()[:8], "little")
    return torch.Generator().manual_seed(number & (2**63 - 1))
