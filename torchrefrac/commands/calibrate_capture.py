"""Poses, intrinsics and interface of a capture from points whose places are known: of a board, or of a file."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrefrac.atomic import replacing
from torchrefrac.bundle import BundleOptions
from torchrefrac.bundle.rows import MEDIA
from torchrefrac.commands.boards import board_of
from torchrefrac.commands.results import require_replaceable
from torchrefrac.config.importing import UNITS, CalibrateOptions
from torchrefrac.files.cameras import CAMERAS, write_cameras
from torchrefrac.files.capture import PIXEL_SHIFT, load_capture, stated_pixel_shift, write_capture
from torchrefrac.files.known_points import read_known_points
from torchrefrac.files.metadata.boards import Pattern
from torchrefrac.files.paths import real_path
from torchrefrac.files.run import RunRecord
from torchrefrac.files.swap import alone
from torchrefrac.geometry import Rigid
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, CaptureError, Observations, Scene
from torchrefrac.scene.known import KnownPoints
from torchrefrac.sfm.known_points import Calibration, calibrate_by_points

CAPTURE, RESIDUALS = "capture.json", "residuals.csv"
WRITTEN = (CAMERAS, CAPTURE, RESIDUALS)
FEWEST_CORNERS = 6


def calibrate_capture(options: CalibrateOptions, recorder: Recorder) -> dict[str, Any]:
    """Write cameras.json (in the frame of the points), a capture.json with what was found and its errors, residuals.csv
    and metrics.json into the folder `out`; returns the metrics.

    Views that see no board are left out. Raises CaptureError, CalibrationError, UnadjustableError or OutRefusedError.
    """
    folder = Path(options.out).expanduser()
    require_replaceable(folder, "calibrate", WRITTEN)
    capture = load_capture(options.capture or "", with_images=options.points is None)
    known, seeing = _known(capture, options, recorder)
    capture = capture.of_views(seeing)
    scene = _scene_of(capture, known)
    found = calibrate_by_points(scene, BundleOptions(refine=options.refine, pixel_sigma=options.pixel_sigma))
    folder.mkdir(parents=True, exist_ok=True)
    with alone(folder):
        require_replaceable(folder, "calibrate", WRITTEN)
        write_cameras(found.scene, folder / CAMERAS)
        after = found.scene.cameras, found.scene.interfaces
        write_capture(capture.folder / CAPTURE, *after, _sigmas(found), folder / CAPTURE)
        _write_residuals(found.scene, folder / RESIDUALS)
        metrics = {
            "status": "complete",
            "stages": [],
            "command": "calibrate",
            "capture": str(real_path(capture.folder)),
            "images": len(capture),
            "length_unit": capture.length_unit,
        } | calibration_metrics(found)
        RunRecord.of(folder, metrics).write()
    return metrics


def calibration_metrics(found: Calibration) -> dict[str, Any]:
    """What was found, with standard deviations, as flat metrics."""
    scene, known, unit = found.scene, found.known, found.scene.length_unit
    cameras, interfaces = scene.cameras, scene.interfaces
    metrics: dict[str, Any] = {
        "points": len(scene.points),
        "observations": int(scene.accepted.sum()),
        "dropped_observations": int((~scene.accepted).sum()),
        "reprojection_rms_px": found.rms,
        "converged": found.report.status == "converged",
        "index_ratio": scene.index_ratio,
        "determined": [each.sentence for each in found.determined],
        "focal_px": dict(zip(cameras.names, cameras.focal.tolist(), strict=True)),
    }
    if known is not None:
        metrics["pixel_sigma_px"] = known.pixel_sigma
        if "focal" in known.intrinsics:
            metrics["focal_sigma"] = known.intrinsics["focal"][:, 0].tolist()
    places = [
        {
            "kind": interfaces.kinds[row],
            "normal": interfaces.normal[row].tolist(),
            f"offset_{unit}": float(interfaces.offset[row]),
            f"thickness_{unit}": interfaces.thickness[row].tolist(),
        }
        | ({} if known is None else {"sigma": known.planes[row].tolist()})
        for row in range(len(interfaces))
    ]
    return metrics | {"interfaces": places}


def capture_lines(metrics: dict[str, Any]) -> list[str]:
    """What is printed."""
    unit = metrics["length_unit"]
    lines = [
        f"{metrics['observations']} observations of {metrics['points']} known points in {metrics['images']} images "
        f"({metrics['dropped_observations']} left out), error {metrics['reprojection_rms_px']:.3f} px (RMS)"
    ]
    for place in metrics["interfaces"]:
        height = place.get("sigma", [0.0, 0.0, 0.0])[2]
        spread = f" +- {height:.2g}" if height else ", as stated"
        distance = abs(place[f"offset_{unit}"])
        what = "ahead of the camera" if place["kind"] == "port" else "from the origin of the points"
        normal = ", ".join(f"{part:.5f}" for part in place["normal"])
        lines.append(f"{place['kind']}: {distance:.5g} {unit}{spread} {what}, normal {normal}")
    return [*lines, *metrics["determined"]]


def _known(capture: Capture, options: CalibrateOptions, recorder: Recorder) -> tuple[KnownPoints, list[int]]:
    """The points, and the views that see any, by which the observations number them."""
    if options.points is not None:
        known = read_known_points(Path(options.points), capture.names, stated_pixel_shift(capture.folder))
    else:
        known = _corners(capture, board_of(options), recorder)
        if isinstance(options.square, str):  # with a unit, so that the corners are in m
            known = KnownPoints(known.points / _meters(capture), known.observations)
    seeing = known.observations.view.unique()
    if not len(seeing):
        raise CaptureError("no photograph shows a known point; check the board, or the file of points")
    slot = torch.zeros(len(capture), dtype=torch.long).index_put((seeing,), torch.arange(len(seeing)))
    seen = replace(known.observations, view=slot[known.observations.view])
    return KnownPoints(known.points, seen), seeing.tolist()


def _meters(capture: Capture) -> float:
    """How long the unit of a capture is."""
    if capture.length_unit not in UNITS:
        wanted = f"give square as a number of {capture.length_unit}, without a unit"
        raise CaptureError(f"{capture.folder / CAPTURE}: length_unit is {capture.length_unit!r}; {wanted}")
    return UNITS[capture.length_unit]


def _corners(capture: Capture, board: Pattern, recorder: Recorder) -> KnownPoints:
    """The corners of a board; in the unit of the sides that the options state."""
    rows = []
    places: dict[int, list[float]] = {}
    for view, path in enumerate(recorder.track(capture.paths, len(capture), "looking for the board", "photograph")):
        for one in board.find(path).certain:
            if len(one.number) < FEWEST_CORNERS:
                continue
            places |= dict(zip(one.number.tolist(), one.place.astype(np.float64).tolist(), strict=True))
            rows += [(int(number), view, *pixel) for number, pixel in zip(one.number, one.pixels.tolist(), strict=True)]
    numbers = {number: i for i, number in enumerate(sorted(places))}
    rows.sort(key=lambda row: numbers[row[0]])
    points = torch.tensor([places[number] for number in numbers], dtype=torch.float64).reshape(-1, 3)
    pixels = torch.tensor([row[2:] for row in rows], dtype=torch.float64).reshape(-1, 2) + PIXEL_SHIFT["center"]
    view = torch.tensor([row[1] for row in rows], dtype=torch.long)
    point = torch.tensor([numbers[row[0]] for row in rows], dtype=torch.long)
    return KnownPoints(points, Observations(view, point, pixels))


def _scene_of(capture: Capture, known: KnownPoints) -> Scene:
    pose = Rigid.identity(len(capture))
    return Scene.create(
        pose,
        capture.cameras,
        capture.interfaces,
        known.points,
        known.observations,
        names=capture.names,
        camera=capture.camera,
        interface=capture.interface,
        length_unit=capture.length_unit,
    )


def _sigmas(found: Calibration) -> list[dict[str, float]]:
    """How uncertain what was refined of each interface still is."""
    interfaces, known = found.scene.interfaces, found.known
    if known is None:
        return [dict(interfaces.sigmas) for _ in range(len(interfaces))]
    media = {name: known.medium_sigma(name) for name in known.layout.water if name in MEDIA}
    planes = known.planes.tolist()
    return [media | {"plane_tilt": max(first, second), "plane_height": height} for first, second, height in planes]


def _write_residuals(scene: Scene, path: Path) -> None:
    seen, errors = scene.observations, scene.errors()
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write("X,Y,Z,view,x,y,error_px,used\n")
        for row, (view, point) in enumerate(zip(seen.view.tolist(), seen.point.tolist(), strict=True)):
            place = ",".join(f"{value:.9g}" for value in scene.points[point].tolist())
            pixel = ",".join(f"{value:.4f}" for value in seen.pixels[row].tolist())
            used = int(scene.accepted[row])
            file.write(f"{place},{scene.views.names[view]},{pixel},{float(errors[row]):.4f},{used}\n")
