"""A camera from photographs of a board in air, by OpenCV, into a camera.json."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32

from torchrefrac.commands.boards import board_of
from torchrefrac.config.importing import CalibrateOptions
from torchrefrac.files.metadata.boards import Pattern
from torchrefrac.files.metadata.camera_file import write_camera
from torchrefrac.files.metadata.header import read_header
from torchrefrac.files.metadata.lens import GUESSED_SIGMA, Lens
from torchrefrac.files.metadata.listing import list_photographs
from torchrefrac.files.paths import real_path
from torchrefrac.recorder import Recorder
from torchrefrac.scene.capture import CaptureError

FEWEST_PHOTOGRAPHS = 4  # from different sides; fewer leave the focal length open
FEWEST_CORNERS = 8  # of a board in a photograph that is used
LEAST_SIGMA = 1e-4  # relative; boards are not flatter than that
LEAST_CENTER_SIGMA = 0.05  # px
COVERAGE = 0.6  # of the image's sides that corners must reach over
LEAST_TILT_DEG = 15.0  # between two photographs; where all show the board from one side, any focal length fits
UNDETERMINED = 0.02  # relative sigma of a focal length from which on it is said
FISHEYE: Any = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # where OpenCV 5 and 4 have its flags
FLAGS = {"opencv": 0, "rational": cv2.CALIB_RATIONAL_MODEL}
COEFFICIENTS = {"opencv": 5, "rational": 8, "fisheye": 4}
MOST_PARTS = 10  # that photographs are divided into, to see what leaving one out changes
Corners = tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 2"]]


@dataclass(frozen=True)
class Calibration:
    """The lens with what is not sure about it. rms: in px, over all corners. worst: photograph with the largest error,
    and that. without: photographs in which no board was found."""

    size: tuple[int, int]
    lens: Lens
    rms: float
    photographs: int
    corners: int
    worst: tuple[str, float]
    without: tuple[str, ...]
    undetermined: tuple[str, ...]


def calibrate(options: CalibrateOptions, recorder: Recorder) -> Calibration:
    """Write the camera.json. Raises CaptureError where the board is found in too few photographs, or they have several
    sizes."""
    pictures = list_photographs(options.sources, real_path(options.out)).pictures
    found = _find(pictures, board_of(options), recorder)
    without = tuple(path.name for path in pictures if path not in found)
    if len(found) < FEWEST_PHOTOGRAPHS:
        remedy = "check board, columns, rows and dictionary, and photograph it from several sides"
        raise CaptureError(
            f"the board was found in {len(found)} of {len(pictures)} photographs, but must be in "
            f"{FEWEST_PHOTOGRAPHS} at least; {remedy}"
        )
    size = _common_size(list(found))
    result = _calibrated(size, found, options, without)
    about = {
        "rms_px": round(result.rms, 4), "photographs": result.photographs, "corners": result.corners,
        "not_determined": list(result.undetermined), "without_board": list(without),
    }  # fmt: skip
    write_camera(Path(options.out).expanduser(), size, result.lens, about)
    return result


def calibration_lines(result: Calibration, out: str) -> list[str]:
    """What is printed."""
    lens = result.lens
    lines = [
        f"{result.corners} corners in {result.photographs} photographs of {result.size[0]} x {result.size[1]}, "
        f"error {result.rms:.3f} px (root mean square), {result.worst[1]:.3f} px in {result.worst[0]}",
        f"focal length {lens.focal[0]:.2f}, {lens.focal[1]:.2f} px +- {100.0 * lens.sigma:.2g} %, principal point "
        f"{lens.principal_point[0]:.2f}, {lens.principal_point[1]:.2f} px from the corner",
        "distortion " + ", ".join(f"{number:.5g}" for number in lens.distortion),
        *(f"not determined: {sentence}" for sentence in result.undetermined),
    ]
    if result.without:
        lines.append(f"no board was found in {', '.join(result.without)}")
    return [*lines, f"written to {out}; go on with: torchrefrac import camera={out} ..."]


def _find(pictures: Sequence[Path], board: Pattern, recorder: Recorder) -> dict[Path, Corners]:
    found: dict[Path, Corners] = {}
    for path in recorder.track(pictures, len(pictures), "looking for the board", "photograph"):
        for one in board.find(path).seen:
            if len(one.number) >= FEWEST_CORNERS:
                found[path] = one.place, one.pixels
    return found


def _common_size(paths: Sequence[Path]) -> tuple[int, int]:
    sizes = {path: read_header(path)[:2] for path in paths}
    first = sizes[paths[0]]
    for path, size in sizes.items():
        if size != first:
            other = f"{paths[0].name} is {first[0]}x{first[1]}"
            raise CaptureError(f"{path} is {size[0]}x{size[1]}, but {other}; calibrate each size apart")
    return first


def _calibrated(
    size: tuple[int, int], found: Mapping[Path, Corners], options: CalibrateOptions, without: tuple[str, ...]
) -> Calibration:
    corners = list(found.values())
    try:
        numbers, errors, tilt = _fitted(size, corners, options.model)
        sigma = _jackknife(size, corners, options.model)
    except cv2.error as error:
        remedy = "photograph the board larger, sharper and from more sides"
        raise CaptureError(f"the camera cannot be calibrated from these photographs ({error.err}); {remedy}") from None
    fx, fy, cx, cy, *distortion = numbers.tolist()
    counts = np.array([len(pixels) for _, pixels in corners])
    worst, source = int(errors.argmax()), Path(options.out).name
    relative = max(float(sigma[0]) / fx, float(sigma[1]) / fy, LEAST_SIGMA if tilt > LEAST_TILT_DEG else GUESSED_SIGMA)
    model = "fisheye" if options.model == "fisheye" else "opencv"
    return Calibration(
        size=size,
        lens=Lens(
            (fx, fy),
            (cx + 0.5, cy + 0.5),
            tuple(distortion),
            relative,
            source,
            source,
            source,
            model,
            max(float(sigma[2]), float(sigma[3]), LEAST_CENTER_SIGMA),
            max(float(sigma[4:].max()), LEAST_SIGMA),
        ),
        rms=math.sqrt(float((errors**2 * counts).sum() / counts.sum())),
        photographs=len(found),
        corners=int(counts.sum()),
        worst=(list(found)[worst].name, float(errors[worst])),
        without=without,
        undetermined=tuple(_undetermined(size, corners, relative, sigma)),
    )


def _fitted(
    size: tuple[int, int], corners: Sequence[Corners], model: str
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " m"], float]:
    """fx, fy, cx, cy as OpenCV counts pixels, and the coefficients; the error of each photograph (px, root mean
    square); and by how many degrees the board was tilted from one photograph to another at most."""
    places, pixels = (list(part) for part in zip(*corners, strict=True))
    if model == "fisheye":
        across = [part.reshape(-1, 1, 3).astype(np.float64) for part in places]
        seen = [part.reshape(-1, 1, 2).astype(np.float64) for part in pixels]
        flags = FISHEYE.CALIB_RECOMPUTE_EXTRINSIC | FISHEYE.CALIB_FIX_SKEW
        _, matrix, coefficients, turns, shifts = cv2.fisheye.calibrate(
            across, seen, size, np.zeros((3, 3)), np.zeros((4, 1)), flags=flags
        )
        projected = [cv2.fisheye.projectPoints(part, turn, shift, matrix, coefficients)[0]
                     for part, turn, shift in zip(across, turns, shifts, strict=True)]  # fmt: skip
    else:
        _, matrix, coefficients, turns, shifts = cv2.calibrateCamera(
            places,
            pixels,
            size,
            None,
            None,
            flags=FLAGS[model],  # type: ignore[arg-type]
        )
        projected = [cv2.projectPoints(part, turn, shift, matrix, coefficients)[0]
                     for part, turn, shift in zip(places, turns, shifts, strict=True)]  # fmt: skip
    errors = [math.sqrt(float(np.square(there.reshape(-1, 2) - part).sum(axis=1).mean()))
              for there, part in zip(projected, pixels, strict=True)]  # fmt: skip
    numbers = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients.ravel()[: COEFFICIENTS[model]])
    normals = np.stack([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilt = math.degrees(math.acos(min(max(float((normals @ normals.T).min()), -1.0), 1.0)))
    return np.array(numbers), np.array(errors), tilt


def _jackknife(size: tuple[int, int], corners: Sequence[Corners], model: str) -> Float[np.ndarray, " k"]:
    """Standard deviations of the numbers: from how they change where a part of the photographs is left out (Quenouille
    1956, Tukey 1958). Corners of one photograph have errors in common, which OpenCV's own deviations do not know."""
    parts = min(len(corners), MOST_PARTS)
    without = np.stack(
        [_fitted(size, [one for i, one in enumerate(corners) if i % parts != part], model)[0] for part in range(parts)]
    )
    spread = np.square(without - without.mean(axis=0)).sum(axis=0)
    return np.sqrt((parts - 1) / parts * spread)


def _undetermined(
    size: tuple[int, int], corners: Sequence[Corners], relative: float, sigma: Float[np.ndarray, " k"]
) -> Iterator[str]:
    """What these photographs leave open, and what would help."""
    if relative > UNDETERMINED:
        yield f"the focal length, to {relative:.0%}: photograph the board tilted by 30 degrees and more"
    middle = max(float(sigma[2]) / size[0], float(sigma[3]) / size[1])
    if middle > UNDETERMINED:
        yield f"the principal point, to {middle:.0%} of the image: turn the camera by 90 degrees for some photographs"
    pixels = np.concatenate([part for _, part in corners])
    for name, reach in zip(("width", "height"), np.ptp(pixels, axis=0) / np.array(size), strict=True):
        if reach < COVERAGE:
            yield f"distortion beyond the middle {reach:.0%} of the {name}: bring the board to the edges of the image"
