"""A camera in a file of its own: what `torchrefrac calibrate` writes and `torchrefrac import` takes."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrefrac.files.capture import pixel_shift
from torchrefrac.files.fields import read_json, write_json
from torchrefrac.files.intrinsics import read_cameras_table
from torchrefrac.files.metadata.lens import CALIBRATED_SIGMA, Lens
from torchrefrac.scene.capture import CaptureError

FORMAT = "torchrefrac-camera/1"


def write_camera(path: Path, size: tuple[int, int], lens: Lens, about: Mapping[str, Any]) -> None:
    """about: what else is to be told of the calibration."""
    write_json({"format": FORMAT, "pixel_origin": "corner", "camera": lens.content(size), **about}, path)


def read_camera(path: Path) -> tuple[tuple[int, int], Lens]:
    """Width and height, and the lens. Raises CaptureError for whatever is wrong with the file."""
    top = read_json(path, "does not exist, but camera must be a file that `torchrefrac calibrate` wrote")
    top.must_be("format", FORMAT)
    fields, shift = top.object("camera"), pixel_shift(top, top.text("pixel_origin"))
    cameras = read_cameras_table({"camera": fields}, shift)
    intrinsics, (fx, fy), (cx, cy) = cameras[0], cameras.focal[0].tolist(), cameras.principal_point[0].tolist()
    is_fisheye = intrinsics.fisheye is not None
    coefficients = intrinsics.distortion.tolist()
    focal_sigma, *others = (float(column[0]) for column in (
        cameras.focal_sigma, cameras.principal_point_sigma, cameras.distortion_sigma
    ))  # fmt: skip
    center_sigma, distortion_sigma = (sigma or None for sigma in others)
    source = path.name
    lens = Lens(
        (fx, fy), (cx, cy), tuple(coefficients[:4] if is_fisheye else coefficients), focal_sigma or CALIBRATED_SIGMA,
        source, source, source, "fisheye" if is_fisheye else "opencv", center_sigma, distortion_sigma,
    )  # fmt: skip
    return cameras.sizes[0], lens


def lens_for(path: Path, size: tuple[int, int]) -> Lens:
    """The lens of a file for photographs of some size: that of the calibration, or scaled to photographs that are
    smaller or larger in both ways alike. Raises CaptureError where they have other sides."""
    calibrated, lens = read_camera(path)
    ratio = size[0] / calibrated[0]
    if abs(size[1] - ratio * calibrated[1]) > 1.0:
        found, wanted = (f"{width}x{height}" for width, height in (size, calibrated))
        raise CaptureError(f"{path} is of photographs of {wanted}, but these are {found}; calibrate with such")
    (fx, fy), (cx, cy) = lens.focal, lens.principal_point
    sigma = None if lens.center_sigma is None else ratio * lens.center_sigma
    return replace(lens, focal=(ratio * fx, ratio * fy), principal_point=(ratio * cx, ratio * cy), center_sigma=sigma)
