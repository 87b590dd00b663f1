"""Runs that are killed go on where they were, and end with the same cameras as one that nobody disturbs."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCENE = ("scene=riverbed", "scene.columns=6", "scene.rows=6", "scene.obliques=0")
CAMERA = ("scene.camera.width=480", "scene.camera.height=360", "scene.boulders=80")
PATIENCE_S = 900.0


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A folder in which a run has been made, in `calm`."""
    folder = tmp_path_factory.mktemp("runs")
    assert _begun(folder, "calm").wait(PATIENCE_S) == 0
    return folder


@pytest.mark.slow
def test_a_run_that_is_killed_at_every_stage_ends_with_the_same_cameras(undisturbed):
    moments = [
        _parts("features", 10),
        _parts("matching", 6),
        _parts("verification", 4),
        _stage("matching"),
        _stage("sparse"),
    ]
    for reached in moments:
        process = _begun(undisturbed, "killed")
        _wait_until(lambda reached=reached: reached(undisturbed / "killed"), process)
        process.kill()
        process.wait()
    assert _begun(undisturbed, "killed").wait(PATIENCE_S) == 0

    assert _cameras(undisturbed / "killed") == _cameras(undisturbed / "calm")
    assert not (undisturbed / "killed" / "work").exists()


@pytest.mark.slow
def test_a_run_that_loses_workers_ends_with_the_same_cameras(undisturbed):
    process = _begun(undisturbed, "robbed")
    for reached in (_parts("features", 5), _parts("verification", 3)):
        _wait_until(lambda reached=reached: reached(undisturbed / "robbed"), process)
        os.kill(_children(process.pid)[-1], signal.SIGKILL)

    assert process.wait(PATIENCE_S) == 0
    assert _cameras(undisturbed / "robbed") == _cameras(undisturbed / "calm")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of a cluster that loses a worker
def test_a_run_by_a_cluster_that_loses_a_worker_ends_with_the_same_cameras(undisturbed, tmp_path):
    distributed = pytest.importorskip("distributed")
    where = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "local_directory": str(tmp_path)}
    with distributed.LocalCluster(**where) as cluster:
        process = _begun(undisturbed, "cluster", "executor=dask", f"executor.address={cluster.scheduler_address}")
        _wait_until(lambda: _parts("matching", 3)(undisturbed / "cluster"), process)
        os.kill(cluster.workers[0].process.pid, signal.SIGKILL)
        assert process.wait(PATIENCE_S) == 0

    assert _cameras(undisturbed / "cluster") == _cameras(undisturbed / "calm")


def _begun(folder, out, *executor):
    """The run, in a process of its own, by default with two workers."""
    how = executor or ("executor.workers=2",)
    command = [sys.executable, "-m", "torchrefrac", *SCENE, *CAMERA, *how, "report=false", f"out={out}"]
    about = os.environ | {"TORCHREFRAC_CACHE": str(folder / "cache"), "OMP_NUM_THREADS": "1"}
    with (folder / f"{out}.log").open("a", encoding="utf-8") as log:
        return subprocess.Popen([*command, "quiet=true"], cwd=folder, env=about, stderr=log, stdout=log)


def _parts(stage, count):
    """Whether so many parts of a stage are done."""
    return lambda run: len(list(run.glob(f"work/{stage}-*/part_*.npz"))) >= count


def _stage(name):
    """Whether a stage is done."""
    return lambda run: name in json.loads((run / "metrics.json").read_text(encoding="utf-8"))["stages"]


def _wait_until(reached, process):
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert process.poll() is None, "the run has ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _children(process):
    """Workers of a process, by their numbers: it has a thread for each that it began."""
    listed = Path(f"/proc/{process}/task").glob("*/children")
    numbers = [int(number) for path in listed for number in path.read_text(encoding="ascii").split()]
    workers = [n for n in numbers if "spawn_main" in Path(f"/proc/{n}/cmdline").read_text(encoding="ascii")]
    return sorted(workers)


def _cameras(run):
    return (run / "cameras.json").read_bytes()
