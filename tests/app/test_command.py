"""The command line as a person uses it: exit status, sentences, and the files that are left."""

import json
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchrefrac.cli import commands
from torchrefrac.commands import sparse as sparse_stage
from torchrefrac.config import FolderOptions, ModelOptions, Options, OutputOptions, RunOptions, WaterOptions
from torchrefrac.files.cameras import load_cameras, load_points
from torchrefrac.files.capture import load_capture

RESULTS = {"cameras.json", "points.ply", "metrics.json", "side_view.png", "features.npz", "matches.npz", "tracks.npz"}

OF_A_SWEEP = {"figure1.png", "multirun.yaml", "report.html", "summary.csv", "summary.md", "summary.png", "sweep.json"}
OF_A_SWEEP |= {"table1.md"}
OF_DENSE_RUNS = {"dense_figure1.png", "dense_error_map.png"}
FEWER = "features.max_features=2000"


def test_a_run_leaves_the_promised_files_and_a_right_reconstruction(complete_run, metrics):
    run, ended = complete_run
    assert (ended.status, ended.err.count("error")) == (0, 0)
    assert "4 of 4 images registered" in ended.out
    assert {p.name for p in run.iterdir()} == RESULTS | {"events", "run.log", ".hydra"}
    found = metrics(run)
    assert found["status"] == "complete"
    assert found["stages"] == ["features", "matching", "sparse"]
    assert (found["pairs_matched"], found["pairs_possible"], found["pairs_by"]) == (6, 6, "exhaustive")
    assert found["registered_images"] == 4
    assert found["camera_rms_cm"] < 0.05
    assert found["surface_median_cm"] < 0.1
    points, colors = load_points(run / "points.ply")
    assert len(points) == found["points"] > 1000
    assert colors.float().std() > 10
    assert (points[:, 2] < 0).all()
    cameras = load_cameras(run / "cameras.json")
    assert cameras.center_in_world[0].tolist() == pytest.approx([0.0, 0.0, 30.0], abs=1e-9)
    events = EventAccumulator(str(run / "events"), size_guidance={"tensors": 1}).Reload()
    assert {"adjustment/cost", "verification/inliers", "registration/images"} <= set(events.Tags()["scalars"])
    assert any(tag.startswith("sparse") for tag in events.Tags()["tensors"])


def test_the_same_seed_gives_the_same_cameras(torchrefrac, sparse, tmp_path):
    torchrefrac("scene=capture", f"scene.path={sparse / 'capture'}", "out=second")
    first, second = (run / "cameras.json" for run in (sparse / "run", tmp_path / "second"))
    assert first.read_bytes() == second.read_bytes()


def test_a_multirun_over_the_models_ends_with_table_and_figure(both_models, metrics):
    folder, ended = both_models
    both = folder / "both"
    assert ended.status == 0
    assert {p.name for p in both.iterdir()} == {"0_none", "1_refractive", *OF_A_SWEEP, *OF_DENSE_RUNS}
    for page in (both, both / "0_none", both / "1_refractive"):
        assert 10_000 < (page / "report.html").stat().st_size < 5_000_000
    assert 'href="1_refractive/report.html"' in (both / "report.html").read_text()
    none, refractive = metrics(both / "0_none"), metrics(both / "1_refractive")
    assert none["camera_rms_cm"] > 10 * refractive["camera_rms_cm"]
    assert none["alignment"] == "similarity"
    assert refractive["alignment"] == "4-dof"
    table = (both / "table1.md").read_text()
    assert table.strip() in ended.out
    assert none["capture"] == str(folder / "capture")
    assert "No refraction" in table
    assert "Refraction" in table
    assert cv2.imread(str(both / "figure1.png")).std() > 5


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["scene=capture"], "scene.path is missing; give it on the command line as scene.path=VALUE"),
        (["scene=capture", "scene.path=nowhere"], "nowhere is not a folder"),
        (["water.index_ratio=0.5"], "water.index_ratio is 0.5, but must lie between 1 and 3"),
        (["sfm.max_error=big"], "sfm.max_error is 'big', but must be a number"),
        (["model.name=best"], "model.name is 'best', but must be one of none, radial, bundler, refractive"),
    ],
)
def test_bad_input_is_one_sentence_a_failed_status_and_no_results(torchrefrac, metrics, tmp_path, arguments, sentence):
    ended = torchrefrac(*arguments, "out=run")
    assert ended.status == 1
    assert f"error: {sentence}" in ended.err
    assert "Traceback" not in ended.err
    assert metrics(tmp_path / "run")["status"] == "failed"
    assert sentence in metrics(tmp_path / "run")["reason"]
    assert not RESULTS - {"metrics.json"} & {p.name for p in (tmp_path / "run").iterdir()}


def test_a_folder_that_is_used_again_does_not_pass_old_metrics_off_as_new(torchrefrac, metrics, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.json").write_text('{"status": "complete"}')
    assert torchrefrac("scene=capture", "scene.path=nowhere", "out=run").status == 1
    assert metrics(tmp_path / "run")["status"] == "failed"


def test_an_unknown_scene_or_option_does_not_start(torchrefrac):
    for argument in ("scene=pond", "sfm.max_eror=3"):
        assert torchrefrac(argument, "out=run").status == 1


def test_images_without_texture_make_no_pair(torchrefrac, small_tank, metrics):
    for path in (small_tank / "images").iterdir():
        cv2.imwrite(str(path), np.full((480, 640, 3), 127, dtype=np.uint8))
    ended = torchrefrac("scene=capture", f"scene.path={small_tank}", "out=run")
    assert ended.status == 1
    assert "error: no pair of images has 20 matches that agree on a pose" in ended.err
    run = small_tank.parent / "run"
    assert metrics(run)["stages"] == ["features"]
    assert (run / "features.npz").is_file()
    assert not (run / "cameras.json").exists()


def test_an_image_that_cannot_be_registered_is_named_and_the_others_are_reconstructed(
    torchrefrac, half_of_tank, tmp_path, metrics
):
    tank = half_of_tank([0, 1, 2, 3])
    cv2.imwrite(str(tank / "images" / "cam02.jpg"), np.full((240, 320, 3), 127, dtype=np.uint8))
    ended = torchrefrac("scene=capture", f"scene.path={tank}", "out=run")
    assert ended.status == 0
    assert "not registered: cam02.jpg sees only 0 reconstructed points" in ended.out
    found = metrics(tmp_path / "run")
    assert (found["images"], found["registered_images"]) == (4, 3)
    assert list(found["not_registered"]) == ["cam02.jpg"]
    entry = json.loads((tmp_path / "run" / "cameras.json").read_text())["images"][2]
    assert entry["registered"] is False


def test_two_images_are_enough(torchrefrac, part_of_tank, tmp_path, metrics):
    folder = part_of_tank([0, 3])
    assert torchrefrac("scene=capture", f"scene.path={folder}", FEWER, "out=run").status == 0
    assert metrics(tmp_path / "run")["registered_images"] == 2


def test_an_interrupt_leaves_the_finished_stages(torchrefrac, small_tank, metrics, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sparse_stage, "reconstruct_sparse", interrupted)
    ended = torchrefrac("scene=capture", f"scene.path={small_tank}", FEWER, "out=run")
    assert ended.status == 130
    run = small_tank.parent / "run"
    assert metrics(run)["status"] == "interrupted"
    assert metrics(run)["stages"] == ["features", "matching"]
    assert {"features.npz", "matches.npz"} <= {p.name for p in run.iterdir()}
    assert not (run / "cameras.json").exists()
    assert not list(run.glob(".*partial*"))


def test_a_failed_job_of_a_multirun_does_not_stop_the_others(torchrefrac, sparse, tmp_path, metrics):
    capture = sparse / "capture"
    ended = torchrefrac("-m", "scene=capture", f"scene.path={capture}", "water.index_ratio=0.5,1.33", "out=runs")
    assert ended.status == 1
    runs = sorted(p for p in (tmp_path / "runs").iterdir() if p.is_dir())
    assert [metrics(run)["status"] for run in runs] == ["failed", "complete"]


def test_the_installed_command_answers():
    command = shutil.which("torchrefrac") or [sys.executable, "-m", "torchrefrac"]
    command = [command] if isinstance(command, str) else command
    ended = subprocess.run([*command, "--help"], capture_output=True, text=True, check=False)
    assert ended.returncode == 0
    assert "tank_small" in ended.stdout


@pytest.mark.parametrize(("model", "ratio"), [("none", 1.0), ("radial", 1.0), ("refractive", 1.333)])
def test_the_table_of_runs_has_the_index_ratio_that_a_model_sees(half_of_tank, model, ratio):
    capture = load_capture(half_of_tank([0, 3]))
    options = Options(model=ModelOptions(name=model), water=WaterOptions(index_ratio=1.333))
    run = RunOptions(FolderOptions("tank_small"), options, OutputOptions(out="run"))

    compared = commands._compared(run, capture, {})

    assert (compared["model"], compared["water.index_ratio"]) == (model, ratio)
