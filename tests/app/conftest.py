"""The command line in this process, and a small real capture for it."""

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from torchrefrac import cli
from torchrefrac.cli import commands, sweeps
from torchrefrac.scene.library import embedded_scene


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
            cli.main()
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
