"""A camera in a file of its own: what `torchrefrac calibrate` writes and `torchrefrac import` takes."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from torchrefrac.files.capture import pixel_shift
from torchrefrac.files.fields import read_json, write_json
from torchrefrac.files.intrinsics import read_cameras_table
from torchrefrac.files.metadata.lens import CALIBRATED_SIGMA, Lens
from torchrefrac.scene.capture import CaptureError

FORMAT = "torchrefrac-camera/1"


def write_camera(path: Path, size: tuple[int, int], lens: Lens, about: Mapping[str, Any]) -> None:
    """about: what else is to be told of the calibration."""
    write_json({"format": FORMAT, "pixel_origin": "corner", "camera": lens.content(size), **about}, path)


class CameraFile(NamedTuple):
    """A lens, and the width and height of the photographs that it was calibrated with."""

    path: Path
    size: tuple[int, int]
    lens: Lens

    def for_size(self, size: tuple[int, int]) -> Lens:
        """The lens for photographs of some size: as it is, or scaled to photographs that are smaller or larger in both
        ways alike. Raises CaptureError where they have other sides."""
        ratio = size[0] / self.size[0]
        if abs(size[1] - ratio * self.size[1]) > 1.0:
            found, wanted = (f"{width}x{height}" for width, height in (size, self.size))
            raise CaptureError(f"{self.path} is of photographs of {wanted}, but some are {found}; calibrate with such")
        (fx, fy), (cx, cy), sigma = self.lens.focal, self.lens.principal_point, self.lens.center_sigma
        return replace(
            self.lens,
            focal=(ratio * fx, ratio * fy),
            principal_point=(ratio * cx, ratio * cy),
            center_sigma=None if sigma is None else ratio * sigma,
        )


def read_camera(path: Path) -> CameraFile:
    """Raises CaptureError for whatever is wrong with the file."""
    top = read_json(path, "does not exist, but camera must be a file that `torchrefrac calibrate` wrote")
    top.must_be("format", FORMAT)
    cameras = read_cameras_table({"camera": top.object("camera")}, pixel_shift(top, top.text("pixel_origin")))
    intrinsics, (fx, fy), (cx, cy) = cameras[0], cameras.focal[0].tolist(), cameras.principal_point[0].tolist()
    is_fisheye = intrinsics.fisheye is not None
    coefficients = intrinsics.distortion.tolist()
    lens = Lens(
        focal=(fx, fy),
        principal_point=(cx, cy),
        distortion=tuple(coefficients[:4] if is_fisheye else coefficients),
        sigma=float(cameras.focal_sigma[0]) or CALIBRATED_SIGMA,
        source=path.name,
        center_source=path.name,
        distortion_source=path.name,
        model="fisheye" if is_fisheye else "opencv",
        center_sigma=float(cameras.principal_point_sigma[0]) or None,
        distortion_sigma=float(cameras.distortion_sigma[0]) or None,
    )
    return CameraFile(path, cameras.sizes[0], lens)
