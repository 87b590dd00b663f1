"""A survey from photographs to rasters: its bed against the true one, in the reference system of the map.

    python tools/bench/survey.py [--width 1200] [--control 0] [--seeds 1] [--folder FOLDER] [--noise 0.3]

Makes a river's bed that two cameras photograph from a drone with RTK (2 and 3 cm, gimbal to 0.3 degrees), imports the
photographs by what is written in them, reconstructs the bed and writes all products (`outputs=survey`). What they say
is read by rasterio alone, and compared with the true surface where its cells lie on the map. `--control N`: N ground
control points and as many check points on the bed, clicked with noise in pixels; where they appear is found by Fermat's
principle, point by point, and not by the camera of this package. `--seeds`: so many flights with other errors, which
share the photographs' geometry but nothing else. `--folder` keeps all files.
"""

import argparse
import json
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from baseline import bench_parser, figure
from scipy.interpolate import LinearNDInterpolator
from scipy.optimize import brentq

from torchrefrac.files.capture import load_capture
from torchrefrac.files.truth import load_truth
from torchrefrac.scene import Georeference, Truth
from torchrefrac.synthetic.drone import ORIGIN

FOV_DEG = (65.0, 50.0)
SHORE = 0.05  # m below the water, from which on a cell counts as bed
COVERED = (1.0, 1.959964, 3.0)


@dataclass(frozen=True)
class Flight:
    """Of one flight: differences of the bed's cells from the truth, their sigmas, and what the run says of itself."""

    off: np.ndarray
    sigma: np.ndarray
    metrics: dict[str, Any]


def main() -> None:
    parser = bench_parser("A survey against the truth, on the map.")
    parser.add_argument("--width", type=int, default=1200, help="of the photographs, pixels")
    parser.add_argument("--control", type=int, default=0, help="ground control points, and as many check points")
    parser.add_argument("--noise", type=float, default=0.3, help="of their clicks, pixels")
    parser.add_argument("--seeds", type=int, default=1, help="flights")
    parser.add_argument("--folder", type=Path, help="where all files stay")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        flights = [_fly(folder, seed, options) for seed in range(options.seeds)]
    _print(flights)


def _fly(folder: Path, seed: int, options: argparse.Namespace) -> Flight:
    made = _made(folder / "scenes", seed, options.width)
    capture, run = folder / f"flight{seed}", folder / f"run{seed}"
    shutil.rmtree(capture, ignore_errors=True)
    _torchrefrac("import", f"photos={made / 'images'}", f"out={capture}")
    for path in made.glob("truth*"):
        shutil.copy(path, capture)
    truth = load_truth(made)
    assert truth is not None
    surface = _surface(truth)
    if options.control:
        survey = _survey(truth, surface, capture, options.control, options.noise, seed)
        (capture / "survey.json").write_text(json.dumps(survey), encoding="utf-8")
    _torchrefrac(
        "scene=capture", f"scene.path={capture}", "dense=patch", "outputs=survey", "outputs.depth_maps=false",
        f"out={run}",
    )  # fmt: skip
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    return Flight(*_off(run, surface, _place(capture)), metrics)


def _made(cache: Path, seed: int, width: int) -> Path:
    """The folder of the made scene."""
    cameras = ",".join(f"{{width:{width},height:{3 * width // 4},fov_deg:{fov}}}" for fov in FOV_DEG)
    before = set(cache.glob("*")) if cache.is_dir() else set()
    with tempfile.TemporaryDirectory() as out:
        _torchrefrac(
            "scene=riverbed", f"scene.cameras=[{cameras}]", "scene.metadata=drone", f"scene.seed={seed}",
            f"cache={cache}", "model=none", "features.max_features=1000", f"out={out}",
        )  # fmt: skip
    (folder,) = set(cache.glob("riverbed_*")) - before or cache.glob("riverbed_*")
    return folder


def _torchrefrac(*arguments: str) -> None:
    command = [sys.executable, "-m", "torchrefrac", *arguments]
    ended = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    if ended.returncode:
        sys.exit(f"{' '.join(command)} ended with status {ended.returncode}: {ended.stderr[-500:]}")


def _place(capture: Path) -> Georeference:
    """Where the made scene truly stands on the map: its water at a height that no file of the run says."""
    found = load_capture(capture).georeference
    assert found is not None
    return Georeference(found.crs, ORIGIN, found.vertical, found.scale)


def _surface(truth: Truth) -> LinearNDInterpolator:
    """Height of the true bed over x and y."""
    assert truth.surface is not None
    vertices = truth.surface.vertices.numpy()
    return LinearNDInterpolator(vertices[:, :2], vertices[:, 2])


def _off(run: Path, surface: LinearNDInterpolator, place: Georeference) -> tuple[np.ndarray, np.ndarray]:
    with rasterio.open(run / "dsm.tif") as file:
        height, grid = file.read(1).astype(float), file.transform
    with rasterio.open(run / "sigma.tif") as file:
        sigma = file.read(1).astype(float)
    east, north, water = place.origin
    row, column = np.nonzero(np.isfinite(height) & (height < water - SHORE))
    x, y = grid * (column + 0.5, row + 0.5)
    off = height[row, column] - water - surface((x - east) / place.scale, (y - north) / place.scale)
    known = np.isfinite(off)
    return off[known], sigma[row, column][known]


def _survey(
    truth: Truth, surface: LinearNDInterpolator, capture: Path, count: int, noise: float, seed: int
) -> dict[str, Any]:
    """Ground control points, and check points, where they are clicked, in the local frame of the capture."""
    generator = np.random.default_rng(seed)
    content = json.loads((capture / "capture.json").read_text(encoding="utf-8"))
    cameras = {image["name"]: content["cameras"][image["camera"]] for image in content["images"]}
    origin, scale = content["georeference"]["origin"], content["georeference"].get("scale", 1.0)
    shift = np.array([(ORIGIN[0] - origin[0]) / scale, (ORIGIN[1] - origin[1]) / scale, ORIGIN[2] - origin[2]])
    marks: dict[str, Any] = {}
    while len(marks) < 2 * count:
        x, y = generator.uniform(-14.0, 14.0), generator.uniform(-12.0, 8.0)
        z = float(surface(x, y))
        if not math.isfinite(z) or z > -0.3:
            continue
        point = np.array([x, y, z])
        clicks = dict(_clicks(truth, cameras, point, noise, generator))
        if len(clicks) < 3:
            continue
        is_check = len(marks) >= count
        name = f"{'check' if is_check else 'control'}{len(marks) % count + 1}"
        marks[name] = {"position": (point + shift).tolist(), "sigma": 0.01, "observations": clicks}
        if is_check:
            marks[name]["check"] = True
    return {"format": "torchrefrac-survey/1", "pixel_origin": "corner", "marks": marks}


def _clicks(
    truth: Truth, cameras: dict[str, Any], point: np.ndarray, noise: float, generator: np.random.Generator
) -> Iterator[tuple[str, list[float]]]:
    """Of each photograph that shows a point: where it is clicked."""
    names = sorted(cameras)
    for name, true_name in zip(names, truth.names, strict=True):
        i, camera = truth.names.index(true_name), cameras[name]
        center, rotation = truth.center[i].numpy(), truth.rotation[i].numpy()
        seen = rotation @ (_refrax(center, point, truth.index_ratio or 1.333) - center)
        if seen[2] <= 0.0:
            continue
        u = _true_focal(camera, i) * seen[0] / seen[2] + camera["width"] / 2.0
        v = _true_focal(camera, i) * seen[1] / seen[2] + camera["height"] / 2.0
        if 5.0 < u < camera["width"] - 5.0 and 5.0 < v < camera["height"] - 5.0:
            yield name, [u + noise * generator.standard_normal(), v + noise * generator.standard_normal()]


def _true_focal(camera: dict[str, Any], view: int) -> float:
    return camera["width"] / 2.0 / math.tan(math.radians(FOV_DEG[view % len(FOV_DEG)] / 2.0))


def _refrax(center: np.ndarray, point: np.ndarray, ratio: float) -> np.ndarray:
    """Where the quickest path of light from a point below z = 0 to a camera above meets the water."""
    away = float(np.hypot(*(point - center)[:2]))
    height, depth = center[2], -point[2]

    def slope(r: float) -> float:
        """Derivative of the optical length in the distance r at which the ray meets the water."""
        return r / math.hypot(r, height) - ratio * (away - r) / math.hypot(away - r, depth)

    at = float(brentq(slope, 0.0, away, xtol=1e-13)) / away if away > 1e-9 else 0.0  # type: ignore[arg-type]
    return np.array([*(center[:2] + at * (point - center)[:2]), 0.0])


def _print(flights: list[Flight]) -> None:
    level = np.array([flight.metrics["water_level_m"] - ORIGIN[2] for flight in flights])
    level_sigma = np.array([flight.metrics["water_level_sigma_m"] for flight in flights])
    off = np.concatenate([flight.off for flight in flights])
    sigma = np.concatenate([flight.sigma for flight in flights])
    print(f"{len(flights)} flights, {len(off)} cells of the bed, on the map")
    print(f"median of |dz| {np.median(np.abs(off)):.4f} m, RMS {np.sqrt((off**2).mean()):.4f} m, stated sigma "
          f"{np.median(sigma):.4f} m (median)")  # fmt: skip
    for seed, flight in enumerate(flights):
        words = ", ".join(f"{key} {flight.metrics[key]:.4f}" for key in sorted(flight.metrics) if _is_shown(key))
        print(f"flight {seed}: bias of the bed {flight.off.mean():+.4f} m, water {level[seed]:+.4f} "
              f"+- {level_sigma[seed]:.4f} m; {words}")  # fmt: skip
    shares = [float((np.abs(off) <= times * sigma).mean()) for times in COVERED]
    print("within 1, 1.96 and 3 sigma: " + ", ".join(f"{100.0 * share:.1f} %" for share in shares))
    figure("bed, median |dz|", float(np.median(np.abs(off))), "m", "lower", 0.2)
    figure("water level, RMS", float(np.sqrt((level**2).mean())), "m", "lower", 0.5)


def _is_shown(key: str) -> bool:
    return key.startswith(("check_rms", "control_rms", "mark_rms", "position_rms", "camera_rms"))


if __name__ == "__main__":
    main()
