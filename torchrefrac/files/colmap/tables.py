"""What the files of a COLMAP model hold, before the ids are resolved; and the camera models among them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.scene import SceneError

NO_POINT = -1
MODELS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 6: "FULL_OPENCV"}
MODEL_IDS = {name: number for number, name in MODELS.items()}
PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "FULL_OPENCV": 12}
SHARED_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
OTHER_MODELS = {
    5: "OPENCV_FISHEYE",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
    12: "SIMPLE_DIVISION",
    13: "DIVISION",
    14: "SIMPLE_FISHEYE",
    15: "FISHEYE",
    16: "EUCM",
    17: "EQUIRECTANGULAR",
}


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
    """m images with their K features, in the order of the file.

    ids (m), quaternions wxyz (m, 4) and translations (m, 3) cam_from_world, cameras (m) ids. The features of image i
    are rows starts[i] to starts[i + 1] of pixels (K, 2) and points (K), which holds point ids or NO_POINT.
    """

    names: tuple[str, ...]
    ids: np.ndarray
    quaternions: np.ndarray
    translations: np.ndarray
    cameras: np.ndarray
    starts: np.ndarray
    pixels: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class PointTable:
    """n points with their tracks of N elements in all, in the order of the file.

    ids (n), positions (n, 3), colors (n, 3) uint8, errors (n) in pixels or -1, lengths (n) of the tracks; images (N)
    ids and features (N), the place of each element among the features of its image.
    """

    ids: np.ndarray
    positions: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    lengths: np.ndarray
    images: np.ndarray
    features: np.ndarray


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
    if any(distortion[5:]):
        raise SceneError(
            f"{where} is FULL_OPENCV with k4, k5, k6 = {', '.join(f'{k:g}' for k in distortion[5:])}, but only 0 is "
            "understood; calibrate with OPENCV, or undistort the images"
        )
    k = (*distortion[:5], *(0.0,) * (5 - len(distortion[:5])))
    return Intrinsics.create(row.width, row.height, focal, principal, k)


def row_of(intrinsics: Intrinsics, camera: int) -> CameraRow:
    """A camera of a COLMAP model: PINHOLE without distortion, OPENCV without k3, else FULL_OPENCV."""
    numbers = (
        torch.cat((intrinsics.focal, intrinsics.principal_point, intrinsics.distortion))
        .detach()
        .cpu()
        .double()
        .tolist()
    )
    k1, k2, p1, p2, k3 = numbers[4:]
    if not any(numbers[4:]):
        model = "PINHOLE"
    elif k3 == 0.0:
        model = "OPENCV"
    else:
        model = "FULL_OPENCV"
    full = (*numbers[:4], k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return CameraRow(camera, model, intrinsics.width, intrinsics.height, full[: PARAMETERS[model]])
