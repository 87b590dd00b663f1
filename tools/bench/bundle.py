"""Bundle adjustment beside Ceres: same scene, same start, same tolerance, same machine; and of thousands of views.

    python tools/bench/bundle.py --ceres FOLDER [--only peers,large,jacobian,iterative] [--threads 1,2]
    python tools/bench/bundle.py --only flight [--views 1000,2000,5000] [--solvers banded,iterative] [--uncertainty]

`--ceres` is a folder with ba.cc, CMakeLists.txt (needs Ceres 2.1 and CMake) and make_scene.py: it is copied and built
in a temporary folder, or in `--work`, where scenes are kept too. Every run is a process of its own, timed without the
reading of the scene and, where compiled, without compiling. Per scene and number of threads: seconds a step of
Levenberg-Marquardt (a trial step, accepted or not, with its linear solve), ratio to Ceres (analytic derivatives,
DENSE_SCHUR), trial steps, final cost (half the sum of squares), peak memory. With one thread seconds are those of the
processor, whatever else it does meanwhile; Ceres's are those of a run less those of reading. large: 1000
cameras, 3 million observations. jacobian: exact derivatives against those with the refrax ratio frozen. iterative: the
reduced system by conjugate gradients. OpenMP's threads wait by spinning here, for which the machine must be idle.

flight: lines of views over a river (flight.py), 300 points a view, with the focal length refined; each by every solver,
from the same start to the same minimum. uncertainty: and then how well everything is known.
"""

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from baseline import bench_parser, figure

SCENES = {"50 cameras": (50, 20_000), "200 cameras": (200, 60_000)}
LARGE = (1000, 300_000)
TOLERANCE = 1e-10
HEADER = f"{'':<34} {'s / step':>9} {'ratio':>6} {'steps':>6} {'half SSE':>17} {'s':>7} {'GiB':>6}"


def main() -> None:
    parser = bench_parser("Bundle adjustment beside Ceres.")
    parser.add_argument("--ceres", type=Path, help="folder of the Ceres program and the scenes' generator")
    parser.add_argument("--only", default="peers,large,jacobian,iterative")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--views", default="1000,2000,5000", help="of the flights")
    parser.add_argument("--solvers", default="banded,iterative", help="of the flights' reduced systems")
    parser.add_argument("--uncertainty", action="store_true", help="of the flights, too")
    parser.add_argument("--work", type=Path, help="where to build and keep scenes (a temporary folder)")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    for flag in ("compiled", "frozen", "iterative", "flight"):
        parser.add_argument(f"--{flag}", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.flight:
        print(json.dumps(_fly(arguments)))
        return
    if arguments.worker:
        print(json.dumps(_work(arguments)))
        return
    parts, threads = arguments.only.split(","), [int(t) for t in arguments.threads.split(",")]
    if "flight" in parts:
        _flights(arguments)
        parts.remove("flight")
    if not parts:
        return
    if arguments.ceres is None:
        sys.exit("--ceres is missing; it must be the folder with ba.cc and make_scene.py")
    with tempfile.TemporaryDirectory() as temporary:
        work = (arguments.work or Path(temporary)).resolve()
        program = _build(arguments.ceres, work)
        print(HEADER)
        if "peers" in parts:
            for name, (cameras, points) in SCENES.items():
                scene = _scene(work, cameras, points)
                for count in threads:
                    _compare(program, scene, name, count)
        if "jacobian" in parts:
            scene = _scene(work, *SCENES["50 cameras"])
            _show("50 cameras, exact", _run(scene, 1))
            _show("50 cameras, ratio frozen", _run(scene, 1, "--frozen"))
        if "large" in parts:
            _show("1000 cameras", _run(_scene(work, *LARGE), max(threads)))
        if "iterative" in parts:
            _show("50 cameras, iterative", _run(_scene(work, *SCENES["50 cameras"]), max(threads), "--iterative"))


def _flights(arguments: argparse.Namespace) -> None:
    print(HEADER)
    for views in arguments.views.split(","):
        for solver in arguments.solvers.split(","):
            flags = ["--flight", "--views", views, "--solvers", solver, "--threads", "1"]
            result = _worker(1, [*flags, *(["--uncertainty"] if arguments.uncertainty else [])])
            _show(f"flight of {views} views, {solver}", result)
            figure(
                f"flight of {views} views, {solver}: time of a step",
                result["seconds"] / result["steps"],
                "s",
                "lower",
                0.3,
            )
            figure(f"flight of {views} views, {solver}: memory", result["peak"], "GiB", "lower")
            if arguments.uncertainty:
                print(f"{'':4}{result['uncertainty']}")


def _fly(arguments: argparse.Namespace) -> dict[str, Any]:
    """The adjustment of a flight, in a process of its own."""
    import torch  # noqa: PLC0415 - the process that only starts others does not need these
    from flight import PIXEL_SIGMA, make_flight  # noqa: PLC0415

    from torchrefrac.bundle import BundleOptions, adjust, uncertainty  # noqa: PLC0415
    from torchrefrac.optim import LevenbergMarquardtOptions  # noqa: PLC0415

    torch.set_num_threads(1)
    views = int(arguments.views)
    flight = make_flight(views, 300 * views)
    options = BundleOptions(
        loss="squared",
        pixel_sigma=PIXEL_SIGMA,
        refine=("focal",),
        reduced_solver=arguments.solvers,
        solver=LevenbergMarquardtOptions(function_tolerance=TOLERANCE),
    )
    start = time.process_time()
    report = adjust(flight.start, options, terms=[flight.positions])
    seconds = time.process_time() - start
    result: dict[str, Any] = {"seconds": seconds, "steps": report.iterations, "cost": report.costs[-1]}
    if arguments.uncertainty:
        start = time.process_time()
        known = uncertainty(report.problem, report.scene, PIXEL_SIGMA)
        center, point = known.pose[:, 3:, 3:].diagonal(dim1=1, dim2=2).sum(dim=1).sqrt(), known.point_sigma
        result["uncertainty"] = (
            f"{time.process_time() - start:.1f} s: centres {float(center.median()):.2g} m, points "
            f"{float(point.median()):.2g} m, focal length {float(known.intrinsics['focal'].max()):.2g}, in the median"
        )
    return result | {"peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}


def _compare(program: Path, scene: Path, name: str, threads: int) -> None:
    label = f"{name}, {threads} thread{'s' if threads > 1 else ''}, "
    peer = _ceres(program, scene, threads)
    _show(label + "Ceres", peer)
    for kind, flags in (("eager", []), ("compiled", ["--compiled"])):
        ours = _run(scene, threads, *flags)
        _show(label + kind, ours, peer)


def _show(label: str, result: dict[str, Any], peer: dict[str, Any] | None = None) -> None:
    each = result["seconds"] / result["steps"]
    ratio = f"{each / (peer['seconds'] / peer['steps']):.2f}" if peer else ""
    if peer:
        figure(f"{label}: time of a step to Ceres's", each / (peer["seconds"] / peer["steps"]), "x", "lower", 0.2)
        figure(f"{label}: memory to Ceres's", result["peak"] / peer["peak"], "x", "lower")
    print(
        f"{label:<34} {each:>9.3f} {ratio:>6} {result['steps']:>6} {result['cost']:>17.9g} {result['seconds']:>7.2f} "
        f"{result['peak']:>6.2f}",
        flush=True,
    )


def _build(source: Path, work: Path) -> Path:
    folder = work / "ceres"
    if not (folder / "build" / "ba").exists():
        shutil.copytree(source, folder, dirs_exist_ok=True)
        for command in (["cmake", "-S", ".", "-B", "build"], ["cmake", "--build", "build"]):
            subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    return folder / "build" / "ba"


def _scene(work: Path, cameras: int, points: int) -> Path:
    scene = work / f"scene_{cameras}"
    if not scene.with_suffix(".npz").exists():
        command = [sys.executable, work / "ceres" / "make_scene.py", "--ncam", str(cameras), "--npt", str(points)]
        subprocess.run([*command, "--per", "10", "--out", scene], check=True, stdout=subprocess.DEVNULL)
    return scene


def _ceres(program: Path, scene: Path, threads: int) -> dict[str, Any]:
    printed, of_all, _, peak = _run_ceres(program, scene, threads, 50)
    steps = re.search(r"Linear solver +[\d.]+ \((\d+)\)", printed)
    cost = re.search(r"-> (\S+) rms", printed)
    assert steps is not None
    assert cost is not None
    seconds = _minimizer(printed)
    if threads == 1:
        printed, reading, wall, _ = _run_ceres(program, scene, threads, 0)
        seconds = of_all - reading * (1.0 - _minimizer(printed) / wall)
    return {"seconds": seconds, "steps": int(steps[1]), "cost": float(cost[1]), "peak": peak}


def _minimizer(printed: str) -> float:
    seconds = re.search(r"minimizer ([\d.]+) s", printed)
    assert seconds is not None
    return float(seconds[1])


def _run_ceres(program: Path, scene: Path, threads: int, steps: int) -> tuple[str, float, float, float]:
    """What it prints, its seconds of the processor and of the clock, and its peak memory."""
    command = [program, scene.with_suffix(".txt"), "analytic", "dense_schur", str(threads), str(steps)]
    pinned = ["taskset", "-c", str(max(os.sched_getaffinity(0)))] if threads == 1 else []
    start = time.perf_counter()
    process = subprocess.Popen([*pinned, *command], env=os.environ | {"FULL": "1"}, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    printed = process.stdout.read()
    _, _, usage = os.wait4(process.pid, 0)
    used = usage.ru_utime + usage.ru_stime
    return printed, used, time.perf_counter() - start, usage.ru_maxrss / 2**20


def _run(scene: Path, threads: int, *flags: str) -> dict[str, Any]:
    return _worker(threads, ["--worker", str(scene.with_suffix(".npz")), "--threads", str(threads), *flags])


def _worker(threads: int, arguments: list[str]) -> dict[str, Any]:
    """What this program measures with these arguments."""
    limits = {"OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    command = [sys.executable, __file__, *arguments]
    done = subprocess.run(command, env=os.environ | limits, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def _work(arguments: argparse.Namespace) -> dict[str, Any]:
    """One adjustment, in a process of its own."""
    import numpy as np  # noqa: PLC0415 - the process that only starts others does not need these
    import torch  # noqa: PLC0415

    from torchrefrac.bundle import BundleOptions, adjust  # noqa: PLC0415
    from torchrefrac.camera import Intrinsics  # noqa: PLC0415
    from torchrefrac.geometry import Rigid, so3_exp  # noqa: PLC0415
    from torchrefrac.optim import LevenbergMarquardtOptions  # noqa: PLC0415
    from torchrefrac.scene import Interfaces, Observations, Scene  # noqa: PLC0415

    threads = int(arguments.threads)
    torch.set_num_threads(threads)
    if threads == 1:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    with np.load(arguments.worker) as file:
        data = {name: torch.from_numpy(file[name]) for name in ("ci", "pi", "uv", "aa0", "C0", "X0")}
        focal, index_ratio = float(file["f"]), float(file["delta"])
    order = data["pi"].argsort(stable=True)
    scene = Scene.create(
        Rigid(so3_exp(data["aa0"]), data["C0"]),
        Intrinsics.create(1, 1, focal, (0.0, 0.0)),
        Interfaces.level(index_ratio),
        data["X0"],
        Observations(data["ci"][order].long(), data["pi"][order].long(), data["uv"][order]),
    )
    options = BundleOptions(
        loss="squared",
        compiled=arguments.compiled,
        jacobian="frozen_ratio" if arguments.frozen else "exact",
        reduced_solver="iterative" if arguments.iterative else "auto",
        solver=LevenbergMarquardtOptions(max_iterations=50, function_tolerance=TOLERANCE),
    )
    if arguments.compiled:
        adjust(scene, BundleOptions(loss="squared", compiled=True, solver=LevenbergMarquardtOptions(1)))
    clock = time.process_time if threads == 1 else time.perf_counter
    start = clock()
    report = adjust(scene, options, check=False)
    seconds = clock() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"seconds": seconds, "steps": report.iterations, "cost": report.costs[-1], "peak": peak}


if __name__ == "__main__":
    main()
