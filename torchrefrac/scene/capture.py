"""A capture: the photographs of one scene and what is known about them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.checks import TorchrefracError
from torchrefrac.scene.extent import WaterExtent
from torchrefrac.scene.georeference import Georeference
from torchrefrac.scene.interfaces import Interfaces
from torchrefrac.scene.tables import Cameras

RELATIVE_HEIGHT_SIGMA = 0.01
"""Of a stated height. What images say is more exact by far."""


class CaptureError(TorchrefracError, ValueError):
    """The capture cannot be used; the message names the file or field and the remedy."""


@dataclass(frozen=True, eq=False)
class Capture:
    """Photographs by names and paths, each with its camera, its interface and gravity where that is known.

    camera and interface: rows of the tables, by default the first. down_in_cam: unit vectors with expected errors of
    down_sigma radians, infinite where it is not known (they are the optical axes then); has_gravity: whether it is of
    any. height above the water in length_unit where has_height says that it was measured, with expected errors of
    height_sigma, infinite elsewhere; by default RELATIVE_HEIGHT_SIGMA of it. position of the camera's centre in
    length_unit in the local frame of the georeference, with expected errors of position_sigma along each axis, infinite
    where it is not known. heading: compass heading of the image's top after levelling, radians clockwise from north
    (world +y), with an error of degrees, where has_heading; reports alone look at it. normal_in_cam: unit normals,
    towards the camera, of the walls that images look through, with expected errors of normal_sigma radians, infinite
    where it is not known. gravity_in_cam, gravity_sigma: where down_in_cam is the direction into a wall, which gravity
    is not. water_extent: where the water ends, if that is known. georeference: where the local frame
    stands, if that is known. epochs: names of the times between which the level of the water may have changed, where
    there are several; epoch: rows of these. folder: where the capture was read from; truth, if any, lies beside it.
    damaged: photographs that were listed but are not here, by name, and what is wrong with their files.
    """

    folder: Path
    names: tuple[str, ...]
    paths: tuple[Path, ...]
    cameras: Cameras
    interfaces: Interfaces
    down_in_cam: Float[Tensor, "m 3"]
    down_sigma: Float[Tensor, " m"]
    height: Float[Tensor, " m"]
    has_height: Bool[Tensor, " m"]
    length_unit: str
    has_gravity: bool = True
    heading: Float[Tensor, " h"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    has_heading: Bool[Tensor, " h"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.bool))
    camera: Int[Tensor, " c"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    interface: Int[Tensor, " c"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    height_sigma: Float[Tensor, " s"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    position: Float[Tensor, "p 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    position_sigma: Float[Tensor, "p 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    water_extent: WaterExtent | None = None
    georeference: Georeference | None = None
    normal_in_cam: Float[Tensor, "c 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    normal_sigma: Float[Tensor, " c"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    gravity_in_cam: Float[Tensor, "c 3"] = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.float64))
    gravity_sigma: Float[Tensor, " c"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    epochs: tuple[str, ...] = ()
    epoch: Int[Tensor, " c"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    damaged: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        unknown = torch.full_like(self.down_in_cam, torch.inf)
        by_default = {
            "heading": torch.zeros_like(self.height),
            "has_heading": torch.zeros_like(self.has_height),
            "camera": torch.zeros(len(self), dtype=torch.long),
            "interface": torch.zeros(len(self), dtype=torch.long),
            "epoch": torch.zeros(len(self), dtype=torch.long),
            "height_sigma": torch.full_like(self.height, torch.inf),
            "normal_in_cam": self.down_in_cam.new_tensor((0.0, 0.0, -1.0)).repeat(len(self), 1),
            "normal_sigma": torch.full_like(self.height, torch.inf),
            "gravity_in_cam": self.down_in_cam,
            "gravity_sigma": self.down_sigma,
            "position": torch.zeros_like(unknown),
            "position_sigma": unknown,
        }
        for name, values in by_default.items():
            if not len(getattr(self, name)):
                object.__setattr__(self, name, values)
        unsaid = self.has_height & self.height_sigma.isinf()
        sigma = torch.where(unsaid, RELATIVE_HEIGHT_SIGMA * self.height, self.height_sigma)
        object.__setattr__(self, "height_sigma", sigma)

    def __len__(self) -> int:
        return len(self.names)

    def intrinsics_of(self, images: int | list[int]) -> Intrinsics:
        """Those of an image, or of several as a batch (not batched where all images have one camera)."""
        return self.cameras.of_views(self.camera[images])

    def planes(self, images: Sequence[int], pixels: Sequence[Float[Tensor, "_ 2"]]) -> list[Float[Tensor, "_ 2"]]:
        """Ideal image coordinates of pixels in each of some images."""
        return [self.intrinsics_of(i).plane_from_pixels(p) for i, p in zip(images, pixels, strict=True)]

    def typical_focal(self, *images: int) -> float:
        """The mean focal length of images, pixels."""
        return float(self.cameras.focal[self.camera[list(images)]].mean(dim=-1).mean())

    @property
    def photographs_folder(self) -> Path:
        """That in which the first photograph has its name."""
        return self.paths[0].parents[len(Path(self.names[0]).parts) - 1]

    @property
    def index_ratio(self) -> float:
        """Index ratio n_water / n_air of the one interface. Raises CaptureError where there are several."""
        if len(self.interfaces) != 1:
            raise CaptureError(f"{self.folder} has {len(self.interfaces)} interfaces, but only one can be used here")
        return float(self.interfaces.index_ratio[0])

    @property
    def gravity_metrics(self) -> dict[str, str | float]:
        """Whether gravity was measured, and how well it is known in degrees, as metrics of a run."""
        if not self.has_gravity:
            return {"gravity": "unknown"}
        return {"gravity": "measured", "gravity_sigma_deg": round(math.degrees(self.typical_down_sigma), 3)}

    @property
    def typical_down_sigma(self) -> float:
        """Root mean square of the expected errors of gravity that are known, radians; infinite where none is."""
        known = self.down_sigma[self.down_sigma.isfinite()]
        return float(known.square().mean().sqrt()) if len(known) else math.inf

    def of_views(self, rows: Sequence[int]) -> "Capture":
        """Some of the photographs, by their numbers, in this order."""
        return replace(
            self,
            names=tuple(self.names[i] for i in rows),
            paths=tuple(self.paths[i] for i in rows),
            water_extent=self.water_extent and self.water_extent.of_views(rows),
            **{name: getattr(self, name)[list(rows)] for name in PER_VIEW},
        )


PER_VIEW = (
    "down_in_cam", "down_sigma", "height", "has_height", "height_sigma", "position", "position_sigma", "heading",
    "has_heading", "camera", "interface", "epoch", "normal_in_cam", "normal_sigma",
    "gravity_in_cam", "gravity_sigma",
)  # fmt: skip
"""The fields of a capture that have a row for each photograph."""
