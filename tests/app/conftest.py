"""The command line in this process, and a small real capture for it."""

import io
import json
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import pytest

from torchrefrac import launch
from torchrefrac.cli import commands, sweeps
from torchrefrac.commands import densify as densification
from torchrefrac.commands import reconstruct as pipeline
from torchrefrac.config import Options
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.recorder import SilentRecorder


@dataclass(frozen=True)
class Ended:
    """Exit status of a command and what it printed."""

    status: int
    out: str
    err: str


def run_command(arguments, folder, patch, reports=False):
    """Exit status of the command, run in `folder`."""
    patch.chdir(folder)
    patch.setenv("TORCHREFRAC_CACHE", str(folder / "cache"))
    if not reports:
        patch.setattr(commands, "write_report", lambda run: None)
        patch.setattr(sweeps, "write_job_reports", lambda runs, recorder: None)
        patch.setattr(sweeps, "write_sweep_report", lambda folder, runs: None)
    patch.setattr(sys, "argv", ["torchrefrac", *arguments])
    try:
        launch.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.fixture
def torchrefrac(monkeypatch, capsys, tmp_path):
    """Runs the command in an empty folder; report.html, which takes seconds, is written where reports=True alone."""

    def run(*arguments, reports=False):
        status = run_command(arguments, tmp_path, monkeypatch, reports)
        captured = capsys.readouterr()
        return Ended(status, captured.out, captured.err)

    return run


def _copy_part_of_tank(images, folder):
    source = embedded_scene("tank_small")
    content = json.loads((source / "capture.json").read_text())
    content["images"] = [content["images"][i] for i in images]
    (folder / "images").mkdir(parents=True)
    for image in content["images"]:
        shutil.copy(source / "images" / image["name"], folder / "images")
    (folder / "capture.json").write_text(json.dumps(content))
    shutil.copy(source / "truth.json", folder)
    return folder


@pytest.fixture
def part_of_tank(tmp_path):
    """`part_of_tank([0, 3])`: folder of a capture with those images of the embedded scene, and its truth."""
    return lambda images: _copy_part_of_tank(images, tmp_path / "part_of_tank")


def _kept(folder, make):
    """How the command that `make` runs in a folder ended, kept beside its results."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        status = make(patch)
    (folder / "ended.json").write_text(json.dumps([status, out.getvalue(), err.getvalue()]))


def _ended(folder):
    return Ended(*json.loads((folder / "ended.json").read_text()))


@pytest.fixture(scope="session")
def complete_run(made_once):
    """Folder with `run`, which the command made of the small tank with all default options, and how the command ended.
    Not to be changed."""

    def make(folder):
        capture = _copy_part_of_tank([0, 1, 2, 3], folder / "part_of_tank")
        _kept(folder, lambda patch: run_command(["scene=capture", f"scene.path={capture}", "out=run"], folder, patch))

    folder = made_once("complete_run", make)
    return folder / "run", _ended(folder)


@pytest.fixture
def small_tank(part_of_tank):
    """Four neighbouring images of the embedded scene."""
    return part_of_tank([0, 1, 2, 3])


@pytest.fixture
def half_of_tank(tmp_path):
    """`half_of_tank([0, 3])`: folder of a capture with those images of the embedded scene, at half their size."""
    return lambda images: _half_of_tank(images, tmp_path / "half_of_tank")


@pytest.fixture
def metrics():
    """The metrics.json of a run folder."""
    return lambda folder: json.loads((Path(folder) / "metrics.json").read_text())


def _half_of_tank(images, folder):
    """Folder of a capture with those images of the embedded scene, at half their size."""
    capture = _copy_part_of_tank(images, folder)
    content = json.loads((capture / "capture.json").read_text())
    lens = content["intrinsics"]
    assert content["pixel_origin"] == "center"
    lens |= {name: (lens[name] + 0.5) / 2 - 0.5 for name in ("cx", "cy")} | {"width": 320, "height": 240}
    lens |= {name: lens[name] / 2 for name in ("fx", "fy")}
    (capture / "capture.json").write_text(json.dumps(content))
    for path in (capture / "images").iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (320, 240), interpolation=cv2.INTER_AREA))
    return capture


def _make_sparse(folder):
    capture = _half_of_tank((0, 2, 4), folder / "capture")
    recorder, truth = SilentRecorder(), load_truth(capture)
    pipeline.run(load_capture(capture), Options(), recorder, folder / "run", truth=truth)


@pytest.fixture(scope="session")
def sparse(made_once):
    """Folder with `capture`, three images of the embedded scene at half their size, and `run`, their sparse model. Not
    to be changed."""
    return made_once("sparse", _make_sparse)


@pytest.fixture(scope="session")
def both_models(made_once):
    """Folder with `capture`, and `both`, a sweep over two models of it, sparse and dense, with all reports; and
    how the command ended. Not to be changed."""

    def make(folder):
        capture = _half_of_tank((0, 2, 4, 6), folder / "capture")
        scene = ("scene=capture", f"scene.path={capture}", "model=none,refractive")
        dense = (
            "dense=patch",
            "dense.cell=12",
            *(f"outputs.{name}=false" for name in ("mesh", "raster", "depth_maps")),
        )
        _kept(folder, lambda patch: run_command(["-m", *scene, *dense, "out=both"], folder, patch, reports=True))

    folder = made_once("both_models", make)
    return folder, _ended(folder)


@pytest.fixture
def known_sparse(monkeypatch, sparse):
    """A run finds its sparse model at once."""
    known = densification.open_run(sparse / "run").scene

    def reconstruct(capture, _options, _recorder, on_stage, _survey, _work):
        scene = replace(known, capture=capture)
        on_stage("sparse", scene, 0.0)
        return scene

    monkeypatch.setattr(pipeline, "reconstruct", reconstruct)
