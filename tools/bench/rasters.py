"""Rasters of a cloud that is larger than memory: time and peak memory, from a file of points to finished GeoTIFFs.

    python tools/bench/rasters.py [--millions 50] [--side 10000] [--folder FOLDER]

Writes a made cloud of so many points as dense.ply, and from it, in a process of its own, all rasters of `--side` x
`--side` cells, and compares heights and sigmas of some cells with what the points in them say.
"""

import multiprocessing
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import torch
from baseline import bench_parser, figure
from rasterio.windows import Window

from torchrefrac.commands.survey_products import write_rasters
from torchrefrac.config import DenseOutputs
from torchrefrac.dense.rasterize import grid_of
from torchrefrac.files.dense import DenseFile
from torchrefrac.record.recorders import run_recorders
from torchrefrac.scene import Georeference

CHUNK = 1_000_000
PLACE = Georeference("EPSG:32633", (412_345.0, 5_312_345.0, 431.0))
CELL = 0.05


def main() -> None:
    parser = bench_parser("Rasters larger than memory.")
    parser.add_argument("--millions", type=int, default=50, help="points")
    parser.add_argument("--side", type=int, default=10_000, help="cells")
    parser.add_argument("--folder", type=Path, help="where all files stay")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        _write_cloud(folder / "dense.ply", 1_000_000 * options.millions, options.side)
        queue: Any = multiprocessing.get_context("spawn").SimpleQueue()
        process = multiprocessing.get_context("spawn").Process(target=_rasters, args=(folder, queue))
        process.start()
        process.join()
        if process.exitcode:
            raise SystemExit(f"the rasters ended with status {process.exitcode}")
        seconds, peak, metrics = queue.get()
        worst = _checked(folder)
    print(f"{options.millions} million points, {options.side} x {options.side} cells: {seconds:.0f} s, {peak:.2f} GiB")
    print(f"heights of cells are off by {worst:.2g} sigma at most, of 1000; {metrics}")
    figure("time", seconds, "s", "lower", 0.3)
    figure("peak memory", peak, "GiB", "lower")


def _write_cloud(path: Path, count: int, side: int) -> None:
    """Points of a smooth bed with 2 cm of noise, as dense.ply."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    record = np.dtype(
        [(name, "<f8" if name in "xyz" else "<f4") for name in names]
        + [(name, "u1") for name in ("red", "green", "blue")]
        + [("views", "<u2")]
        + [(f"sigma{end}", "<f4") for end in ("", "_relative", "_x", "_y", "_z", "_common")]
        + [("score", "<f4"), ("reference", "<i4")]
    )
    words = {"<f8": "double", "<f4": "float", "|u1": "uchar", "<u2": "ushort", "<i4": "int"}
    lines = ["ply", "format binary_little_endian 1.0", "comment length_unit m", f"element vertex {count}"]
    lines += [f"property {words[record[name].str]} {name}" for name in record.names or ()]
    generator = np.random.default_rng(1)
    with path.open("wb") as file:
        file.write("\n".join([*lines, "end_header", ""]).encode())
        for start in range(0, count, CHUNK):
            some = np.zeros(min(CHUNK, count - start), dtype=record)
            x, y = generator.uniform(0.0, side * CELL, (2, len(some)))
            some["x"], some["y"], some["views"] = PLACE.origin[0] + x, PLACE.origin[1] + y, 5
            some["z"] = _bed(x, y) + 0.02 * generator.standard_normal(len(some))
            some["nz"], some["score"] = 1.0, 0.9
            for end in ("", "_relative", "_x", "_y", "_z"):
                some[f"sigma{end}"] = 0.02
            some.tofile(file)


def _bed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return -2.0 + 0.5 * np.sin(x / 30.0) * np.cos(y / 40.0)


def _rasters(folder: Path, queue: Any) -> None:
    torch.set_num_threads(1)
    start = time.perf_counter()
    with run_recorders(folder, quiet=False, about={}, expected=()) as recorder:
        outputs = DenseOutputs(geotiff=True, raster_cell=CELL)
        points = DenseFile(folder / "dense.ply")
        where = grid_of(points, outputs.raster_cell)
        metrics = write_rasters(points, *where, PLACE, PLACE.crs, outputs, folder, recorder)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    queue.put((time.perf_counter() - start, peak, metrics))


def _checked(folder: Path) -> float:
    """By how many sigmas the heights of some cells are off the bed."""
    generator, worst = np.random.default_rng(2), 0.0
    with rasterio.open(folder / "dsm.tif") as dsm, rasterio.open(folder / "sigma.tif") as sigmas:
        for row, column in generator.integers(0, min(dsm.shape) - 1, (1000, 2)):
            window = Window(column, row, 1, 1)  # type: ignore[call-arg]
            height, sigma = dsm.read(1, window=window)[0, 0], sigmas.read(1, window=window)[0, 0]
            if not np.isfinite(height):
                continue
            x, y = dsm.transform * (column + 0.5, row + 0.5)
            bed = float(_bed(np.array(x - PLACE.origin[0]), np.array(y - PLACE.origin[1]))) + PLACE.origin[2]
            worst = max(worst, abs(float(height) - bed) / float(sigma))
    return worst


if __name__ == "__main__":
    main()
