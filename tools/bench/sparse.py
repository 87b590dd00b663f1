"""Whole sparse runs as a user starts them: accuracy against truth, wall time and peak memory.

    python tools/bench/sparse.py [CAPTURE_FOLDER ...]

Runs every model on the embedded scene and on the captures given, each in a process of its own, and prints a table.
The radial and no-refraction models are the peers: the last column is their camera error over the refractive one.
"""

from pathlib import Path
from typing import Any

from baseline import bench_parser, figure
from whole_runs import MODELS, measured_run

HEADER = (
    f"{'scene':<12} {'model':<11} {'images':>7} {'points':>7} {'camera RMS':>12} {'seconds':>8} {'GiB':>5} {'ratio':>6}"
)


def main() -> None:
    parser = bench_parser("Sparse reconstruction: accuracy, time and memory.")
    parser.add_argument("captures", nargs="*", type=Path, help="folders with capture.json and truth.json")
    scenes = [["scene=tank_small"], *(["scene=capture", f"scene.path={p}"] for p in parser.parse_args().captures)]
    print(HEADER)
    for scene in scenes:
        results = {model: measured_run(*scene, f"model={model}") for model in MODELS}
        name = Path(scene[-1].split("=")[1]).name
        best = _camera_rms(results["refractive"])[0]
        for model, m in results.items():
            error, unit = _camera_rms(m)
            print(
                f"{name:<12} {model:<11} {m['registered_images']:>3}/{m['images']:<3} {m['points']:>7} "
                f"{error:>9.4f} {unit} {m['wall']:>8.1f} {m['peak']:>5.2f} {error / best:>6.0f}x"
            )
            if model == "refractive":
                figure(f"{name}: camera RMS", error, unit, "lower")
                figure(f"{name}: points", m["points"], "points", "higher")
                figure(f"{name}: wall time", m["wall"], "s", "lower", 0.2)
                figure(f"{name}: memory", m["peak"], "GiB", "lower")
            else:
                figure(f"{name}: camera RMS of {model} to refractive", error / best, "x", "higher")


def _camera_rms(metrics: dict[str, Any]) -> tuple[float, str]:
    key = next(key for key in metrics if key.startswith("camera_rms_"))
    return metrics[key], key.removeprefix("camera_rms_")


if __name__ == "__main__":
    main()
