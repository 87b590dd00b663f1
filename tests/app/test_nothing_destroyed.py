"""Earlier results stay whole until there are new ones, whatever goes wrong; inputs, and what no run wrote, for good."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest
import torch

from tests.app.conftest import run_command
from torchrefrac.cli.streams import Unbroken
from torchrefrac.commands import reconstruct as pipeline
from torchrefrac.commands.results import results_in
from torchrefrac.dense import FolderStore
from torchrefrac.files import swap
from torchrefrac.files.capture import load_capture
from torchrefrac.files.run import RunRecord
from torchrefrac.files.swap import FolderInUseError, alone, settle
from torchrefrac.files.tracks import read_run, read_scene
from torchrefrac.files.water import with_water

RUN = ("scene=capture", "scene.path=capture", "out=run")
DENSE = ("dense=depthmap", "dense.cell=24", "outputs.mesh=false", "outputs.raster=false", "outputs.depth_maps=false")
RESULTS = {"cameras.json", "points.ply", "tracks.npz", "metrics.json", "side_view.png"}


def _files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _results(folder):
    """Without the log and events, and what a process that is killed leaves behind."""
    others = (".torchrefrac", "dense/parts/", "work/", "events/", "run.log")
    return {name: content for name, content in _files(folder).items() if not name.startswith(others)}


@pytest.fixture
def place(sparse, tmp_path):
    """Folder with `capture` and `run`, complete results of it, where the command runs."""
    shutil.copytree(sparse / "capture", tmp_path / "capture")
    shutil.copytree(sparse / "run", tmp_path / "run")
    text = (tmp_path / "run" / "metrics.json").read_text()
    (tmp_path / "run" / "metrics.json").write_text(text.replace(str(sparse / "capture"), str(tmp_path / "capture")))
    (tmp_path / "run" / "notes.txt").write_text("mine")
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((*RUN, "features.max_features=0"), "features.max_features is 0, but must be finite and at least 1"),
        ((*RUN, "water.index_ratio=0.5"), "water.index_ratio is 0.5, but must lie between 1 and 3"),
        ((*RUN, f"features.max_features={'9' * 5000}"), "a number on the command line has too many digits"),
        ((*RUN, "sfm.max_error=big"), "sfm.max_error is 'big', but must be a number"),
        (("scene=capture", "scene.path=nowhere", "out=run"), "nowhere is not a folder"),
        (("scene=capture", "out=run"), "scene.path is missing"),
        (("adjust", "alignment=nowhere", "out=run"), "nowhere is not a folder"),
        (("adjust", "alignment=capture", "survey=none.json", "out=run"), "capture holds no run"),
        (("adjust", "alignment=other", "rounds=0", "out=run"), "rounds is 0, but must be finite and at least 1"),
        (("densify", "run=run", "dense.window=4"), "dense.window is 4, but must be odd"),
        (("densify", "run=run", "capture=nowhere"), "nowhere is not a folder"),
    ],
)
def test_what_is_refused_leaves_earlier_results_byte_for_byte(torchrefrac, place, arguments, sentence):
    before = _files(place)

    ended = torchrefrac(*arguments, reports=True)

    assert ended.status == 1
    assert f"error: {sentence}" in ended.err
    assert _files(place) == before
    assert {path.name for path in place.iterdir()} == {"capture", "run"}


@pytest.mark.parametrize(
    ("out", "sentence"),
    [
        ("capture", "out is {}, where the photographs of capture lie; name another folder"),
        ("capture/images", "out is {}, where the photographs of capture lie; name another folder"),
        ("capture/images/new", "out is {}, where the photographs of capture lie; name another folder"),
        ("", "out is empty, but must be the folder for the results"),
        ("mine", "{} holds points.ply, which no run has written; name another folder as out"),
        ("others", "{}/metrics.json is not of a run, but would be replaced; name another folder as out"),
    ],
)
def test_results_never_take_the_place_of_what_no_run_has_written(torchrefrac, place, out, sentence):
    for name, content in (("mine/points.ply", "a cloud"), ("others/metrics.json", '{"accuracy": 0.9}')):
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).write_text(content)
    before = _files(place)

    ended = torchrefrac(*RUN[:2], f"out={out}")

    assert (ended.status, ended.err) == (1, f"error: {sentence.format(place / out)}\n")
    assert _files(place) == before


def test_a_sweep_needs_a_folder_too(torchrefrac, place):
    before = _files(place)

    ended = torchrefrac("-m", *RUN[:2], "model=none,radial", "out=")

    assert (ended.status, ended.err) == (1, "error: out is empty, but must be the folder for the results\n")
    assert _files(place) == before


def test_adjust_does_not_replace_its_inputs(torchrefrac, place):
    water = place / "given" / "water.json"
    water.parent.mkdir()
    water.write_text("{}")
    before = _files(place)

    ended = torchrefrac("adjust", "alignment=run", "water.path=given/water.json", "out=given")

    assert ended.status == 1
    assert "error: water.path is given/water.json, which results in " in ended.err
    assert _files(place) == before


def _failing(error):
    def reconstruct(*_):
        raise error

    return reconstruct


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (pipeline.ReconstructionError("no pair"), 1, "error: no pair\n"),
        (MemoryError("Unable to allocate 9 GiB"), 1, "error: there is not enough memory (Unable to allocate 9 GiB); "),
        (cv2.error("Insufficient memory"), 1, "error: there is not enough memory (Insufficient memory); use smaller"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 1, "error: there is not enough memory (Default"),
        (torch.cuda.OutOfMemoryError("CUDA out of memory"), 1, "error: there is not enough memory (CUDA out of"),
        (KeyboardInterrupt(), 130, "interrupted; "),
    ],
)
def test_a_run_that_fails_leaves_earlier_results_byte_for_byte(
    torchrefrac, place, monkeypatch, error, status, sentence
):
    before = _files(place)
    monkeypatch.setattr(pipeline, "reconstruct", _failing(error))

    ended = torchrefrac(*RUN, reports=True)

    assert ended.status == status
    assert sentence in ended.err
    assert "Traceback" not in ended.err
    assert _files(place) == before


def test_a_lack_of_memory_is_the_reason_in_a_new_folder(torchrefrac, place, monkeypatch, metrics):
    monkeypatch.setattr(pipeline, "reconstruct", _failing(MemoryError("Unable to allocate 9 GiB")))

    assert torchrefrac(*RUN[:2], "out=new").status == 1
    assert metrics(place / "new")["status"] == "failed"
    assert "or a smaller dense.max_tile" in metrics(place / "new")["reason"]


def test_earlier_results_can_be_read_until_the_new_ones_are_complete(torchrefrac, place, known_sparse, monkeypatch):
    before, found = _files(place / "run"), {}
    complete = pipeline.RunFolder.complete

    def looked_at(files, *arguments):
        complete(files, *arguments)
        found.update(_files(place / "run"))

    monkeypatch.setattr(pipeline.RunFolder, "complete", looked_at)

    ended = torchrefrac(*RUN)

    assert ended.status == 0
    assert {name: found[name] for name in before} == before
    after = _files(place / "run")
    assert after["notes.txt"] == b"mine"
    assert after["metrics.json"] != before["metrics.json"]
    assert RunRecord.read(place / "run").overrides["scene.path"] == "capture"
    assert not any(name.startswith(".torchrefrac") for name in after)


def test_a_run_leaves_its_scene_as_a_colmap_model_too(torchrefrac, place, known_sparse):
    torchrefrac(*RUN, "colmap=true")

    run = place / "run"
    assert {path.name for path in (run / "colmap").iterdir()} == {"cameras.bin", "images.bin", "points3D.bin"}
    ours, theirs = read_run(run), with_water(read_scene(run / "colmap"), run / "water.json")
    assert theirs.views.names == ours.views.names
    assert theirs.interfaces.index_ratio == ours.interfaces.index_ratio
    torch.testing.assert_close(theirs.views.center, ours.views.center, rtol=0.0, atol=1e-9)

    torchrefrac(*RUN)
    assert not (run / "colmap").exists()
    assert not (run / "water.json").exists()
    assert (run / "notes.txt").read_text() == "mine"


def test_a_colmap_model_that_no_run_wrote_stays(torchrefrac, place, known_sparse):
    (place / "run" / "water.json").write_text("{}")
    before = _files(place)

    refused = torchrefrac(*RUN, "colmap=true")

    assert refused.status == 1
    assert "run holds water.json, which no run has written" in refused.err
    assert _files(place) == before


@pytest.mark.parametrize("command", [RUN, ("adjust", "alignment=old", "out=run"), ("densify", "run=run")])
def test_a_second_process_is_told_and_touches_nothing(torchrefrac, place, command):
    shutil.copytree(place / "run", place / "old")
    with alone(place / "run"):
        before = _files(place)
        ended = torchrefrac(*command)
        after = _files(place)

    assert ended.status == 1
    assert "is in use by another process; wait until it has ended, or name another folder" in ended.err
    assert after == before


def test_a_folder_that_is_used_by_another_process_is_not_taken(tmp_path):
    """The other one is a process indeed."""
    code = "import sys, time; from pathlib import Path; from torchrefrac.files.swap import alone\n"
    code += "with alone(Path(sys.argv[1])): print('there', flush=True); time.sleep(60)"
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        with pytest.raises(FolderInUseError), results_in(tmp_path):
            pass
        other.kill()
    with results_in(tmp_path) as folder:
        assert folder == tmp_path


def test_sigterm_is_an_interrupt(torchrefrac, place, monkeypatch, metrics):
    def terminated(*_):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5.0)

    monkeypatch.setattr(pipeline, "reconstruct", terminated)
    before = signal.getsignal(signal.SIGTERM)

    ended = torchrefrac(*RUN[:2], "out=new")

    assert ended.status == 130
    assert metrics(place / "new")["status"] == "interrupted"
    assert signal.getsignal(signal.SIGTERM) == before


def test_nobody_has_to_read_to_the_end():
    command = f"{sys.executable} -m torchrefrac --help | head -1; exit ${{PIPESTATUS[0]}}"
    ended = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2]
    )

    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.count("\n") == 1


def test_a_stream_without_a_reader_takes_what_comes():
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", buffering=1) as plain:
        stream = Unbroken(plain)
        for _ in range(3):
            assert stream.write("a line\n") == 7
            stream.flush()
        assert stream.writable()


def test_adjust_takes_ratio_photographs_and_truth_of_the_run(torchrefrac, place, metrics):
    text = (place / "run" / "cameras.json").read_text()
    ratio = metrics(place / "run")["index_ratio"]
    assert f'"index_ratio": {ratio}' in text

    ended = torchrefrac("adjust", "alignment=run", "out=adjusted")

    found = metrics(place / "adjusted")
    assert ended.status == 0
    assert (found["index_ratio"], found["capture"]) == (ratio, str(place / "capture"))
    assert found["camera_rms_cm"] < 1.0


def test_adjust_takes_the_ratio_of_the_photographs_where_the_run_was_without_refraction(torchrefrac, place, metrics):
    for name, found, wanted in (
        ("cameras.json", '"index_ratio": 1.33', '"index_ratio": 1.0'),
        ("metrics.json", '"model": "refractive"', '"model": "none"'),
    ):
        text = (place / "run" / name).read_text()
        assert found in text
        (place / "run" / name).write_text(text.replace(found, wanted))

    ended = torchrefrac("adjust", "alignment=run", "out=adjusted")

    assert ended.status == 0, ended.err
    assert read_scene(place / "run").index_ratio == 1.0
    assert metrics(place / "adjusted")["index_ratio"] == load_capture(place / "capture").index_ratio == 1.33


def _killed(step, count):
    """`step` that kills the process instead when it is called for the count-th time."""
    calls = 0

    def do(*arguments, **how):
        nonlocal calls
        calls += 1
        if calls == count:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(*arguments, **how)

    return do


def _in_child(folder, arguments, prepare):
    """The status of the command in a copy of this process, where `prepare(patch)` has changed something."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which the child has no use for
        child = os.fork()
    if child == 0:
        status = 99
        try:
            torch.set_num_threads(1)
            with pytest.MonkeyPatch.context() as patch:
                prepare(patch)
                status = run_command(arguments, folder, patch)
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _in_fresh_child(folder, arguments, prepare):
    """The same in a new process, which takes longer: derivatives cannot be taken in a copy of a process that has taken
    some on several devices."""
    child = multiprocessing.get_context("spawn").Process(target=_command, args=(folder, arguments, prepare))
    child.start()
    child.join()
    return child.exitcode


def _command(folder, arguments, prepare):
    with pytest.MonkeyPatch.context() as patch:
        prepare(patch)
        sys.exit(run_command(arguments, folder, patch))


@dataclass(frozen=True)
class _Killing:
    """Kills the process of a command at a moment."""

    command: str
    moment: str

    def __call__(self, patch):
        if self.moment == "stage":
            owner, name = {
                "run": (pipeline.RunFolder, "stage_done"),
                "adjust": (pipeline.RunFolder, "stage_done"),
                "densify": (FolderStore, "save"),
            }[self.command]
            patch.setattr(owner, name, _killed(getattr(owner, name), 1))
        elif self.moment == "rename":
            patch.setattr(swap, "finish", lambda folder: None)  # nothing is moved
            patch.setattr(Path, "rename", _killed(Path.rename, 1))
        else:
            finish = swap.finish

            def broken_off(folder):
                patch.setattr(swap.os, "replace", _killed(os.replace, 3))
                finish(folder)

            patch.setattr(swap, "finish", broken_off)


@pytest.mark.parametrize(
    ("command", "moment"),
    [("run", "stage"), ("run", "rename"), ("run", "swap"), ("adjust", "stage"), ("adjust", "swap"),
     ("densify", "stage"), ("densify", "swap")],
)  # fmt: skip
def test_killed_the_old_or_the_new_results_are_there_whole(place, known_sparse, command, moment):
    arguments = {
        "run": [*RUN, "quiet=true"],
        "adjust": ["adjust", "alignment=old", "out=run", "quiet=true"],
        "densify": ["densify", "run=run", *DENSE, "quiet=true"],
    }[command]
    shutil.copytree(place / "run", place / "old")
    before = _results(place / "run")

    in_child = _in_fresh_child if command == "densify" else _in_child
    assert in_child(place, arguments, _Killing(command, moment)) == -signal.SIGKILL
    settle(place / "run")

    after = _results(place / "run")
    if moment == "swap":
        assert RunRecord.read(place / "run").is_complete
        assert RESULTS - {"side_view.png"} <= set(after)
        assert after["metrics.json"] != before["metrics.json"]
        assert ("dense.ply" in after) == (command == "densify")
        assert ("colmap/images.txt" in after) == (command == "adjust")
    else:
        assert after == before


def test_what_a_killed_run_has_left_behind_is_cleared_away_by_the_next(torchrefrac, place, known_sparse):
    step = _killed(pipeline.RunFolder.stage_done, 1)
    _in_child(place, RUN, lambda patch: patch.setattr(pipeline.RunFolder, "stage_done", step))
    left = {path.name for path in (place / "run").iterdir()}

    ended = torchrefrac(*RUN)

    assert left > {swap.PARTIAL, swap.LOCK}
    assert ended.status == 0
    assert not any(name.startswith(".torchrefrac") for name in _files(place / "run"))


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "adjust", "densify"])
def test_killed_at_twenty_moments_the_old_or_the_new_results_are_there_whole(place, command):
    arguments = {
        "run": [*RUN, "features.max_features=1000"],
        "adjust": ["adjust", "alignment=old", "out=run"],
        "densify": ["densify", "run=run", *DENSE],
    }[command]
    shutil.copytree(place / "run", place / "old")
    program = [sys.executable, "-m", "torchrefrac", *arguments, "report=false"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    start = time.perf_counter()
    assert subprocess.run(program, cwd=place, env=environment, check=False, capture_output=True).returncode == 0
    whole = time.perf_counter() - start
    for moment in range(20):
        before = _results(place / "run")
        with subprocess.Popen(program, cwd=place, env=environment, stderr=subprocess.DEVNULL) as killed:
            time.sleep(whole * (0.3 + 0.04 * moment))
            killed.kill()
        settle(place / "run")
        after = _results(place / "run")
        assert RunRecord.read(place / "run").is_complete
        assert set(after) == set(before)
        assert after == before or after["metrics.json"] != before["metrics.json"]
