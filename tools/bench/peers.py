"""Whole sparse reconstructions beside COLMAP's, of the same keypoints, by one thread each.

    python tools/bench/peers.py [CAPTURE_FOLDER ...] [--rivers 16,60] [--cache FOLDER]

Each reconstruction is a process of its own; what is measured is its time of the processor from keypoints to the last
adjustment: matching, verification, registration. COLMAP matches all pairs as it does by default, and sees no water;
this package chooses pairs by itself from 40 photographs on. rivers: made river beds from a drone at 25 m, so many
photographs of 1024 x 768 pixels with 8192 keypoints at most.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from baseline import bench_parser, figure


def main() -> None:
    parser = bench_parser("Sparse reconstructions beside COLMAP's.")
    parser.add_argument("captures", nargs="*", type=Path, help="folders with capture.json")
    parser.add_argument("--rivers", default="16,60", help="photographs of made rivers; empty: none")
    parser.add_argument("--cache", type=Path, help="folder of made scenes, by default the user's cache")
    parser.add_argument("--worker", choices=("ours", "colmap"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps((_ours if options.worker == "ours" else _colmap)(options.captures[0])))
        return
    folders = {folder.name: folder for folder in options.captures}
    for count in filter(None, options.rivers.split(",")):
        folders[f"river {count}"] = _river(int(count), options.cache)
    print(
        f"{'':<14}{'images':>8}{'ours: s':>10}{'of':>6}{'points':>9}{'COLMAP: s':>11}{'of':>6}{'points':>9}{'ratio':>8}"
    )
    for name, folder in folders.items():
        ours, peer = (_measured(folder, worker) for worker in ("ours", "colmap"))
        ratio = ours["seconds"] / peer["seconds"]
        print(
            f"{name:<14}{ours['images']:>8}{ours['seconds']:>10.1f}{ours['registered']:>6}{ours['points']:>9}"
            f"{peer['seconds']:>11.1f}{peer['registered']:>6}{peer['points']:>9}{ratio:>8.2f}",
            flush=True,
        )
        figure(f"{name}: time of the processor to COLMAP's", ratio, "x", "lower", 0.2)


def _measured(folder: Path, worker: str) -> dict[str, Any]:
    command = [sys.executable, __file__, folder, "--worker", worker]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def _river(count: int, cache: Path | None) -> Path:
    from torchrefrac.synthetic.library import made_scene  # noqa: PLC0415 - only workers and this need PyTorch
    from torchrefrac.synthetic.options import CameraOptions, SensorOptions  # noqa: PLC0415
    from torchrefrac.synthetic.scenes import RiverbedOptions  # noqa: PLC0415

    rows = math.isqrt(count)
    camera, sensor = CameraOptions(width=1024, height=768, fov_deg=65.0), SensorOptions(samples=2)
    about: dict[str, Any] = {"camera": camera, "sensor": sensor, "rows": rows, "obliques": 0}
    return made_scene(RiverbedOptions(name=f"river{count}", columns=-(-count // rows), **about), cache)


def _ours(folder: Path) -> dict[str, Any]:
    from torchrefrac.commands.reconstruct import reconstruct  # noqa: PLC0415
    from torchrefrac.files.capture import load_capture  # noqa: PLC0415

    begun = []

    def heard(name: str, product: Any, seconds: float) -> None:
        if name == "features":
            begun.append(time.process_time())

    scene = reconstruct(load_capture(folder), on_stage=heard)
    seconds = time.process_time() - begun[0]
    return {
        "images": len(scene.views),
        "registered": scene.views.num_registered,
        "points": len(scene.points),
        "seconds": seconds,
    }


def _colmap(folder: Path) -> dict[str, Any]:
    """Keypoints and descriptors of ours in a database, and COLMAP from there."""
    import pycolmap  # noqa: PLC0415

    from torchrefrac.commands.photographs import extract  # noqa: PLC0415
    from torchrefrac.config import Options  # noqa: PLC0415
    from torchrefrac.files.capture import load_capture  # noqa: PLC0415
    from torchrefrac.recorder import SilentRecorder  # noqa: PLC0415

    capture = load_capture(folder)
    features = extract(capture, Options(), SilentRecorder())
    intrinsics = capture.cameras[0]
    with tempfile.TemporaryDirectory() as temporary:
        database = Path(temporary) / "database.db"
        parameters = [*intrinsics.focal.tolist(), *intrinsics.principal_point.tolist()]
        camera = pycolmap.Camera(model="PINHOLE", width=intrinsics.width, height=intrinsics.height, params=parameters)
        with pycolmap.Database.open(database) as opened:
            number = opened.write_camera(camera)
            for name, found in zip(capture.names, features, strict=True):
                image = opened.write_image(pycolmap.Image(name=name, camera_id=number))
                opened.write_keypoints(image, found.pixels.numpy().astype(np.float32))
                kind: Any = pycolmap.FeatureExtractorType.SIFT
                described = pycolmap.FeatureDescriptors(type=kind, data=_as_colmap_counts(found.unit().numpy()))
                opened.write_descriptors(image, described)
        matching: Any = pycolmap.FeatureMatchingOptions()
        matching.num_threads, matching.use_gpu = 1, False
        mapping: Any = pycolmap.IncrementalPipelineOptions()
        mapping.num_threads = 1
        start = time.process_time()
        pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
        found = pycolmap.incremental_mapping(database, capture.paths[0].parent, temporary, options=mapping)
        seconds = time.process_time() - start
        best = max(found.values(), key=lambda one: one.num_reg_images(), default=None)
    registered, points = (best.num_reg_images(), best.num_points3D()) if best else (0, 0)
    return {"images": len(capture), "registered": registered, "points": points, "seconds": seconds}


def _as_colmap_counts(unit: Any) -> Any:
    """Unit descriptors as bytes, as COLMAP scales them."""
    return np.clip(np.rint(512.0 * unit), 0.0, 255.0).astype(np.uint8)


if __name__ == "__main__":
    main()
