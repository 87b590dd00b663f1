"""Whole runs of flights over a river, of 50 to 400 photographs: time, memory, accuracy, and how these grow.

    python tools/bench/flights.py [--sizes 5x10,10x10,10x20,20x20] [--cache FOLDER] [--exhaustive]

One flight of a drone at 25 m, 20 x 20 photographs of 800 x 600 pixels that overlap by 70 %, with positions good to 3
cm; runs are of rows x columns in its corner, by the command with its defaults: as many processes as there are
processors. The exponent is that of the power of the number of photographs which fits the times
of the processors in all runs. exhaustive:
the same with all pairs matched, for up to 200 photographs, to compare cameras with.
"""

import argparse
import json
import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from baseline import bench_parser, figure
from whole_runs import measured_run

SIDE = 20
STAGES = ("features", "matching", "sparse")


def main() -> None:
    parser = bench_parser("Whole runs of flights.")
    parser.add_argument("--sizes", default="5x10,10x10,10x20,20x20", help="rows x columns")
    parser.add_argument("--cache", type=Path, help="folder of made scenes, by default the user's cache")
    parser.add_argument("--exhaustive", action=argparse.BooleanOptionalAction, default=False)
    options = parser.parse_args()
    flight = _flight(options.cache)
    print(
        f"{'photographs':>11}{'pairs':>10}{'registered':>12}{'points':>9}{'cameras, cm':>13}"
        + "".join(f"{stage + ', s':>13}" for stage in STAGES)
        + f"{'whole, s':>10}{'processors, s':>15}{'GiB':>6}"
    )
    counts, seconds = [], []
    for size in options.sizes.split(","):
        rows, columns = map(int, size.split("x"))
        metrics = _run(flight, rows, columns)
        counts.append(rows * columns)
        seconds.append(metrics["processor"])
        if options.exhaustive and rows * columns <= SIDE * SIDE // 2:
            _run(flight, rows, columns, "matching.pairs=exhaustive")
    if len(counts) > 1:
        exponent = _exponent(counts, seconds)
        print(f"the time of a whole run grows with the number of photographs to the power of {exponent:.2f}")
        figure(f"{counts[0]} to {counts[-1]} photographs: exponent", exponent, "", "lower", 0.1)


def _run(flight: Path, rows: int, columns: int, *more: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        _corner(flight, rows, columns, Path(folder))
        metrics = measured_run("scene=capture", f"scene.path={folder}", "report=false", *more)
    cameras = 100.0 * metrics["camera_rms_m"]
    print(
        f"{rows * columns:>11}{metrics['pairs_matched']:>10}{metrics['registered_images']:>12}{metrics['points']:>9}"
        f"{cameras:>13.3f}"
        + "".join(f"{metrics[f'seconds_{stage}']:>13.0f}" for stage in STAGES)
        + f"{metrics['wall']:>10.0f}{metrics['processor']:>15.0f}{metrics['peak']:>6.2f}",
        flush=True,
    )
    label = f"{rows * columns} photographs{', all pairs' if more else ''}"
    figure(f"{label}: wall time", metrics["wall"], "s", "lower", 0.3)
    figure(f"{label}: camera RMS", cameras, "cm", "lower")
    figure(f"{label}: memory of the main process", metrics["peak"], "GiB", "lower")
    return metrics


def _flight(cache: Path | None) -> Path:
    from torchrefrac.synthetic.library import made_scene  # noqa: PLC0415 - only this needs PyTorch
    from torchrefrac.synthetic.options import CameraOptions, SensorOptions  # noqa: PLC0415
    from torchrefrac.synthetic.scenes import RiverbedOptions  # noqa: PLC0415

    camera, sensor = CameraOptions(width=800, height=600, fov_deg=65.0), SensorOptions(samples=2)
    about: dict[str, Any] = {"camera": camera, "sensor": sensor, "columns": SIDE, "rows": SIDE, "obliques": 0}
    return made_scene(RiverbedOptions(name=f"river{SIDE * SIDE}", overlap=0.7, **about), cache)


def _corner(flight: Path, rows: int, columns: int, folder: Path) -> None:
    """A capture of some of the photographs, with truth and what was measured on site."""
    content = json.loads((flight / "capture.json").read_text(encoding="utf-8"))
    chosen = [SIDE * row + column for row in range(rows) for column in range(columns)]
    content["images"] = [content["images"][i] for i in chosen]
    names = [image["name"] for image in content["images"]]
    survey = json.loads((flight / "survey.json").read_text(encoding="utf-8"))
    survey["images"] = {name: survey["images"][name] for name in names}
    for name, values in (("capture.json", content), ("survey.json", survey)):
        (folder / name).write_text(json.dumps(values), encoding="utf-8")
    for name in filter(lambda name: (flight / name).exists(), ("truth.json", "truth_surface.ply")):
        os.symlink(flight / name, folder / name)
    (folder / "images").mkdir()
    for name in names:
        os.symlink(flight / "images" / name, folder / "images" / name)


def _exponent(counts: Sequence[int], seconds: Sequence[float]) -> float:
    """Of the power that fits best, in logarithms."""
    x, y = ([math.log(value) for value in values] for values in (counts, seconds))
    middle, typical = sum(x) / len(x), sum(y) / len(y)
    return sum((a - middle) * (b - typical) for a, b in zip(x, y, strict=True)) / sum((a - middle) ** 2 for a in x)


if __name__ == "__main__":
    main()
