"""Scenes that are made, through the command: rendered once, reconstructed, measured, and refused in one sentence."""

import errno
import json
import os

import numpy as np
import pytest
import trimesh

from torchrefrac.cli import commands
from torchrefrac.files.run import RunRecord
from torchrefrac.synthetic import folder
from torchrefrac.synthetic.scenes import mesh, tank

SMALL = ("scene.camera.width=320", "scene.camera.height=240", "scene.sensor.samples=1")
TANK = ("scene=tank", "scene.images=4", *SMALL, "features.max_features=1000")
DRAWN = {tank: ("gravel", "beans", "grass"), mesh: ("sand",)}


@pytest.fixture
def plain(monkeypatch):
    """Grey instead of all that is drawn, for what comes to an end before anyone looks for texture."""
    for module, names in DRAWN.items():
        for name in names:
            monkeypatch.setattr(module, name, lambda *_: np.full((8, 8, 3), 120, dtype=np.uint8))


@pytest.fixture
def coarse(monkeypatch):
    """Drawings of a quarter of their size, which photographs as small as these do not tell apart."""

    def quarter(draw):
        return lambda size, seed: draw((size[0] // 4, size[1] // 4), seed)

    for module, names in DRAWN.items():
        for name in names:
            monkeypatch.setattr(module, name, quarter(getattr(module, name)))


@pytest.fixture
def captures(monkeypatch):
    """Names of the folders that were to be reconstructed; nothing is."""
    seen = []

    def run(capture, options, recorder, folder, about, truth):
        seen.append(capture.folder)
        counted = {"images": len(capture), "registered_images": len(capture), "points": 9, "seconds_total": 0.1}
        metrics = {"status": "complete", "stages": [], "model": options.model.name, "capture": str(capture.folder)}
        metrics |= counted | {"reprojection_median_px": 0.1, "gravity": "measured"} | about
        RunRecord.of(folder, metrics).write()
        return metrics

    monkeypatch.setattr(commands, "run", run)
    monkeypatch.setattr("torchrefrac.sweeps.summary.draw_sweep", lambda *_: False)
    return seen


def _log(folder):
    return (folder / "run.log").read_text(encoding="utf-8")


def _times(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_a_tank_is_made_reconstructed_and_measured_and_a_quiet_second_run_takes_it_from_the_cache(
    torchrefrac, coarse, metrics, tmp_path
):
    ended = torchrefrac(*TANK, "cache=elsewhere", "out=first")

    assert (ended.status, ended.err.count("error")) == (0, 0)
    assert "rendering tank" in ended.err
    assert "4 of 4 images registered" in ended.out
    (made,) = (tmp_path / "elsewhere").glob("tank_*")
    assert not (tmp_path / "cache").exists()
    found = metrics(tmp_path / "first")
    assert (found["status"], found["scene"], found["capture"]) == ("complete", "tank", str(made))
    assert found["overrides"] == {name: value for name, _, value in (argument.partition("=") for argument in TANK)}
    assert found["index_ratio"] == found["true_index_ratio"] == 1.333
    assert found["registered_images"] == 4
    assert 0.001 < found["camera_rms_cm"] < 1.5
    assert 0.01 < found["point_median_cm"] < 3.0
    assert 0.01 < found["flatness_cm"] < 0.6
    assert _log(tmp_path / "first").splitlines()[-1].split(" ", 2)[2].startswith("complete after ")
    before = _times(made)

    again = torchrefrac("-q", *TANK, "cache=elsewhere", "out=second")

    assert (again.status, again.out, again.err) == (0, "", "")
    assert _times(made) == before
    assert "rendering" in _log(tmp_path / "first")
    assert "rendering" not in _log(tmp_path / "second")
    assert metrics(tmp_path / "second")["camera_rms_cm"] == found["camera_rms_cm"]


def test_without_another_word_the_cache_is_that_of_the_environment(torchrefrac, plain, captures, tmp_path):
    ended = torchrefrac("-q", *TANK, "out=run")

    assert (ended.status, ended.out, ended.err) == (0, "", "")
    (made,) = (tmp_path / "cache").glob("tank_*")
    assert captures == [made]
    assert len(list((made / "images").iterdir())) == 4


def test_a_quiet_run_that_fails_says_its_one_error(torchrefrac, metrics, tmp_path):
    ended = torchrefrac("-q", "scene=mesh", "scene.file=nowhere.ply", "out=run")

    assert (ended.status, ended.out) == (1, "")
    assert ended.err == "error: scene.file: nowhere.ply cannot be read: No such file or directory\n"
    assert metrics(tmp_path / "run")["reason"] == ended.err.removeprefix("error: ").strip()
    assert _log(tmp_path / "run").splitlines()[-1].split(" ", 2)[2].startswith("failed after ")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["scene=pond"],
            "scene is 'pond', but must be one of aquarium, cans, capture, housing, mesh, riverbed, table, tank, "
            "tank_small",
        ),
        (["scene=tank", "scene.index_ratio=abc"], "scene.index_ratio is 'abc', but must be a number"),
        (
            ["scene=tank", "scene.altitude=30"],
            "scene.altitude is not an option; known here are camera, cameras, depth, ",
        ),
        (["scene=tank_small", "scene.depth=90"], "scene.depth is not an option; known here are name, path"),
        (["scene=tank", "scene.heights=[2000]"], "scene tank: the camera path leaves the scene, cam00.png sees it in "),
        (["scene=tank", *SMALL, "cache=ball.ply"], "cannot be written: "),
        (["scene=mesh"], "scene.file is missing; give it on the command line as scene.file=VALUE"),
        (["scene=mesh", "scene.file=nowhere.ply"], "scene.file: nowhere.ply cannot be read: No such file"),
        (["scene=mesh", "scene.file=words.ply"], "scene.file: words.ply cannot be read as a mesh: "),
        (["scene=mesh", "scene.file=words.doc"], "scene.file: words.doc cannot be read as a mesh: "),
        (["scene=mesh", "scene.file=ball.ply", "scene.depth=0.2"], "the mesh reaches 0.8 m above the water: "),
    ],
)
def test_a_scene_that_cannot_be_made_is_one_sentence(torchrefrac, plain, metrics, tmp_path, arguments, sentence):
    trimesh.creation.icosphere(subdivisions=1, radius=0.5).export(tmp_path / "ball.ply")
    for name in ("words.ply", "words.doc"):
        (tmp_path / name).write_text("no mesh\n")

    ended = torchrefrac(*arguments, "out=run")

    assert ended.status == 1
    assert ended.out == ""
    assert ended.err.startswith("error: ")
    assert sentence in ended.err
    assert ended.err.count("\n") == 1
    assert not list(tmp_path.glob("cache/*/images"))
    if (tmp_path / "run").exists():
        assert metrics(tmp_path / "run")["status"] == "failed"
        assert sentence in metrics(tmp_path / "run")["reason"]


def _write_bumpy_ball(path):
    """Half a metre in radius, with bumps, and a colour of its own at each vertex."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    x, y, z = ball.vertices.T
    reach = 0.5 * (1.0 + 0.08 * np.sin(5.0 * x + 1.0) * np.sin(4.0 * y) + 0.05 * np.sin(7.0 * z))
    colours = np.random.default_rng(7).integers(20, 235, (len(reach), 1)).repeat(3, axis=1).astype(np.uint8)
    ball = trimesh.Trimesh(reach[:, None] * ball.vertices, ball.faces, vertex_colors=colours, process=False)
    ball.export(path)


def test_a_mesh_of_one_s_own_is_put_under_water_and_measured(torchrefrac, coarse, metrics, tmp_path):
    _write_bumpy_ball(tmp_path / "ball.ply")

    ended = torchrefrac(
        "scene=mesh", "scene.file=ball.ply", "scene.images=6", *SMALL, "features.max_features=700", "out=run"
    )  # fmt: skip

    assert (ended.status, ended.err.count("error")) == (0, 0)
    found = metrics(tmp_path / "run")
    assert (found["scene"], found["registered_images"]) == ("mesh", 6)
    assert 0.0 < found["camera_rms_m"] < 0.05
    assert 0.0 < found["point_median_m"] < 0.05
    assert 0.0 < found["flatness_m"] < 0.02


def test_a_disk_that_is_full_while_a_scene_is_rendered_is_named_and_the_other_job_goes_on(
    torchrefrac, plain, captures, metrics, monkeypatch, tmp_path
):
    write, seen = folder.write_photograph, []

    def fill(image, path):
        seen.append(path.name)
        if len(seen) == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write(image, path)

    monkeypatch.setattr(folder, "write_photograph", fill)

    ended = torchrefrac("-m", *TANK, "model=none,refractive", "out=runs")

    assert ended.status == 1
    (made,) = (tmp_path / "cache").glob("tank_*")
    reason = metrics(tmp_path / "runs" / "0_none")["reason"]
    assert reason == (
        f"{made} cannot be written: the disk is full; free space, or give another cache folder (option `cache`); "
        "images that are finished are kept"
    )
    assert ended.err.count(reason) == 1
    assert "Traceback" not in ended.err + _log(tmp_path / "runs" / "0_none")
    assert metrics(tmp_path / "runs" / "1_refractive")["status"] == "complete"
    assert captures == [made]
    assert seen == ["cam00.png", "cam01.png", "cam02.png", "cam02.png", "cam03.png"]
    assert json.loads((made / "scene.json").read_text())["options"]["images"] == 4
