"""What the files of a COLMAP model hold, before the ids are resolved; and the camera models among them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from torchrefrac.camera import Intrinsics
from torchrefrac.files.plausible import implausible
from torchrefrac.scene import SceneError

NO_POINT = -1
FISHEYE = "OPENCV_FISHEYE"
MODELS = {
    0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: FISHEYE, 6: "FULL_OPENCV",
}  # fmt: skip
MODEL_IDS = {name: number for number, name in MODELS.items()}
PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, FISHEYE: 8, "FULL_OPENCV": 12,
}  # fmt: skip
SHARED_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
BY_DEFAULT = ("PINHOLE", "OPENCV", "FULL_OPENCV")
OTHER_MODELS = {
    7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION", 14: "SIMPLE_FISHEYE", 15: "FISHEYE",
    16: "EUCM", 17: "EQUIRECTANGULAR",
}  # fmt: skip
AGAIN = "export the model again"  # the remedy for files that do not fit together


@dataclass(frozen=True)
class CameraRow:
    """One camera: size in pixels and the parameters in the order of its COLMAP model."""

    id: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ImageTable:
    """Images with their features, in the order of the file.

    Quaternions (wxyz) and translations are cam_from_world; cameras are ids. The features of image i are rows starts[i]
    to starts[i + 1] of pixels and points, which holds point ids or NO_POINT.
    """

    names: tuple[str, ...]
    ids: Int[np.ndarray, " m"]
    quaternions: Float[np.ndarray, "m 4"]
    translations: Float[np.ndarray, "m 3"]
    cameras: Int[np.ndarray, " m"]
    starts: Int[np.ndarray, " m+1"]
    pixels: Float[np.ndarray, "k 2"]
    points: Int[np.ndarray, " k"]


@dataclass(frozen=True, eq=False)
class PointTable:
    """Points with the elements of their tracks, in the order of the file.

    errors in pixels or -1; lengths of the tracks; images: ids; features: the place of each element among the features
    of its image.
    """

    ids: Int[np.ndarray, " n"]
    positions: Float[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    errors: Float[np.ndarray, " n"]
    lengths: Int[np.ndarray, " n"]
    images: Int[np.ndarray, " k"]
    features: Int[np.ndarray, " k"]


@dataclass(frozen=True)
class Ids:
    """What a model calls its images, by name, and its cameras, in the order of a scene that was read from it."""

    images: Mapping[str, int]
    cameras: tuple[int, ...]


def parameter_count(model: str, camera: int, path: Path) -> int:
    """How many parameters a camera model has; SceneError for one that `Intrinsics` cannot hold."""
    if model not in PARAMETERS:
        raise SceneError(
            f"{path}: camera {camera} has the model {model}, but understood are {', '.join(PARAMETERS)}; calibrate "
            "with one of these, or undistort the images"
        )
    return PARAMETERS[model]


def intrinsics_of(row: CameraRow, path: Path) -> Intrinsics:
    """What a camera of a COLMAP model describes, exactly: none of the models understood needs a conversion."""
    where = f"{path}: camera {row.id}"
    if row.width < 1 or row.height < 1:
        raise SceneError(f"{where} is {row.width}x{row.height} pixels, but must be at least 1x1; correct its size")
    if not np.isfinite(row.parameters).all():
        raise SceneError(f"{where} has a parameter that is not finite; calibrate it again")
    focals = 1 if row.model in SHARED_FOCAL else 2
    focal = (row.parameters[0], row.parameters[focals - 1])
    principal, distortion = row.parameters[focals : focals + 2], row.parameters[focals + 2 :]
    if min(focal) <= 0.0:
        raise SceneError(f"{where} has a focal length of {min(focal):g}, but it must be above 0; calibrate it again")
    if row.model == FISHEYE:
        intrinsics = Intrinsics.create(row.width, row.height, focal, principal, distortion, model="fisheye")
    else:
        count = 8 if any(distortion[5:]) else 5
        k = (*distortion, *(0.0,) * count)[:count]
        intrinsics = Intrinsics.create(row.width, row.height, focal, principal, k)
    if (wrong := implausible(intrinsics)) is not None:
        raise SceneError(f"{where}: {' '.join(wrong)}")
    return intrinsics


def row_of(intrinsics: Intrinsics, camera: int, read_as: str = "") -> CameraRow:
    """A camera of a COLMAP model: of the one that it was read as, where that holds its numbers; or else OPENCV_FISHEYE
    of a fisheye, PINHOLE without distortion, OPENCV without k3, FULL_OPENCV."""
    numbers = torch.cat((intrinsics.focal, intrinsics.principal_point, intrinsics.distortion)).detach().cpu().double()
    fx, fy, *others = (*numbers.tolist(), 0.0, 0.0, 0.0)
    for model in (FISHEYE,) if intrinsics.fisheye is not None else (read_as, *BY_DEFAULT):
        parameters = [fx, *others] if model in SHARED_FOCAL else [fx, fy, *others]
        count = PARAMETERS.get(model, 0)
        if count and not any(parameters[count:]) and (fx == fy or model not in SHARED_FOCAL):
            return CameraRow(camera, model, intrinsics.width, intrinsics.height, tuple(parameters[:count]))
    raise AssertionError("FULL_OPENCV holds whatever intrinsics there are")
