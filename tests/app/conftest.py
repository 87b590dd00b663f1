"""The command line in this process, and a small real capture for it."""

import json
import shutil
import sys
from dataclasses import dataclass
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
from torchrefrac.recorder import SilentRecorder


@dataclass(frozen=True)
class Ended:
    """Exit status of a command and what it printed."""

    status: int
    out: str
    err: str


@pytest.fixture
def torchrefrac(monkeypatch, capsys, tmp_path):
    """Runs the command in an empty folder; report.html, which takes seconds, is written where reports=True alone."""

    def run(*arguments, reports=False):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("TORCHREFRAC_CACHE", str(tmp_path / "cache"))
        if not reports:
            monkeypatch.setattr(commands, "write_report", lambda run: None)
            monkeypatch.setattr(sweeps, "write_job_reports", lambda runs, recorder: None)
            monkeypatch.setattr(sweeps, "write_sweep_report", lambda folder, runs: None)
        monkeypatch.setattr(sys, "argv", ["torchrefrac", *arguments])
        try:
            launch.main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        captured = capsys.readouterr()
        return Ended(status, captured.out, captured.err)

    return run


@pytest.fixture
def part_of_tank(tmp_path):
    """`part_of_tank([0, 3])`: folder of a capture with those images of the embedded scene, and its truth."""

    def copy(images):
        source, folder = embedded_scene("tank_small"), tmp_path / "part_of_tank"
        content = json.loads((source / "capture.json").read_text())
        content["images"] = [content["images"][i] for i in images]
        (folder / "images").mkdir(parents=True)
        for image in content["images"]:
            shutil.copy(source / "images" / image["name"], folder / "images")
        (folder / "capture.json").write_text(json.dumps(content))
        shutil.copy(source / "truth.json", folder)
        return folder

    return copy


@pytest.fixture
def small_tank(part_of_tank):
    """Four neighbouring images of the embedded scene."""
    return part_of_tank([0, 1, 2, 3])


@pytest.fixture
def metrics():
    """The metrics.json of a run folder."""
    return lambda folder: json.loads((Path(folder) / "metrics.json").read_text())


@pytest.fixture(scope="session")
def sparse(tmp_path_factory):
    """Folder with `capture`, three images of the embedded scene at half their size, and `run`, their sparse model."""
    source, folder = embedded_scene("tank_small"), tmp_path_factory.mktemp("sparse")
    content = json.loads((source / "capture.json").read_text())
    content["images"] = [content["images"][i] for i in (0, 2, 4)]
    lens = content["intrinsics"]
    assert content["pixel_origin"] == "center"
    lens |= {name: (lens[name] + 0.5) / 2 - 0.5 for name in ("cx", "cy")} | {"width": 320, "height": 240}
    lens |= {name: lens[name] / 2 for name in ("fx", "fy")}
    (folder / "capture" / "images").mkdir(parents=True)
    for name in (image["name"] for image in content["images"]):
        image = cv2.imread(str(source / "images" / name))
        cv2.imwrite(
            str(folder / "capture" / "images" / name), cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA)
        )
    (folder / "capture" / "capture.json").write_text(json.dumps(content))
    shutil.copy(source / "truth.json", folder / "capture")
    pipeline.run(load_capture(folder / "capture"), Options(), SilentRecorder(), folder / "run")
    return folder


@pytest.fixture
def known_sparse(monkeypatch, sparse):
    """A run finds its sparse model at once."""
    known = densification.open_run(sparse / "run").reconstruction

    def reconstruct(_capture, _options, _recorder, on_stage):
        on_stage("sparse", known, 0.0)
        return known

    monkeypatch.setattr(pipeline, "reconstruct", reconstruct)
