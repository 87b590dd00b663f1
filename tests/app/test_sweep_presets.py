"""Sweeps that are prepared: what they vary, and how the command line changes them."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from torchrefrac.cli import commands
from torchrefrac.cli.composed import run_options
from torchrefrac.cli.conf import CONF
from torchrefrac.files.run import RunRecord

PRESETS = sorted(path.stem for path in (CONF / "sweep").glob("*.yaml"))


@pytest.fixture
def jobs(monkeypatch):
    """Options of the jobs that were run; nothing is made or reconstructed."""
    seen = []

    def remember(folder, options, settings, config):
        seen.append(options)
        measured = {"images": 2, "registered_images": 2, "points": 9, "reprojection_median_px": 0.1}
        told = {"model": options.reconstruction.model.name, "capture": options.scene.label, "gravity": "measured"}
        RunRecord.of(folder, {"status": "complete", "stages": [], "seconds_total": 0.1} | told | measured).write()

    monkeypatch.setattr(commands, "reconstruct_into", remember)
    monkeypatch.setattr("torchrefrac.sweeps.summary.draw_sweep", lambda *_: False)
    return seen


def test_the_paper_s_table_is_one_run_for_each_model_and_needs_no_m(torchrefrac, jobs, tmp_path):
    ended = torchrefrac("sweep=paper_table1")

    assert ended.status == 0
    assert [job.reconstruction.model.name for job in jobs] == ["none", "radial", "refractive"]
    assert {job.scene.label for job in jobs} == {"tank"}
    (folder,) = (tmp_path / "outputs").iterdir()
    assert folder.name.endswith("_paper_table1")


def test_the_paper_s_experiments_are_both_scenes_with_all_models_and_end_in_a_page_of_their_own(torchrefrac, jobs):
    ended = torchrefrac("sweep=paper", "out=runs")

    assert ended.status == 0
    models = ["none", "radial", "bundler", "refractive"]
    expected = [(scene, model) for scene in ("tank", "cans") for model in models]
    assert [(job.scene.label, job.reconstruction.model.name) for job in jobs] == expected
    assert "[paper.html](paper.html)" in Path("runs/summary.md").read_text(encoding="utf-8")
    assert Path("runs/paper.html").is_file()


def test_other_sweeps_have_no_page_of_the_paper(torchrefrac, jobs):
    torchrefrac("sweep=paper_table1", "out=runs")

    assert not Path("runs/paper.html").exists()


def test_an_index_error_assumes_ratios_on_both_sides_of_the_true_one():
    varied = _varied("index_error")

    true = float(varied["scene.index_ratio"])
    errors = [float(assumed) - true for assumed in varied["water.index_ratio"].split(",")]
    assert errors == pytest.approx([-0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05])


def test_a_gravity_error_grows_from_nothing():
    assert _varied("gravity_error")["scene.inertial.gravity_sigma_deg"] == "0,0.5,1,2,4"


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_composes_for_its_first_values(preset):
    first = [f"{key}={values.split(',')[0]}" for key, values in _varied(preset).items()]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[f"sweep={preset}", *first])

    assert run_options(config).scene.label == "tank"


def _varied(preset):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[f"sweep={preset}"], return_hydra_config=True)
    return config.hydra.sweeper.params


def test_the_command_line_takes_the_place_of_a_preset_s_values(torchrefrac, jobs):
    ended = torchrefrac("sweep=depth", "model=refractive", "scene.depth=60,80", "out=runs")

    assert ended.status == 0
    assert [(job.scene.depth, job.reconstruction.model.name) for job in jobs] == [
        (60.0, "refractive"),
        (80.0, "refractive"),
    ]


def test_another_scene_takes_the_place_of_a_preset_s(torchrefrac, jobs):
    torchrefrac("sweep=paper_table1", "scene=cans", "model=none", "out=runs")

    assert [job.scene.label for job in jobs] == ["cans"]


def test_help_lists_the_presets(torchrefrac):
    ended = torchrefrac("--help")

    assert all(f"  sweep={preset} " in ended.out for preset in PRESETS)
    assert PRESETS == ["depth", "gravity_error", "index_error", "paper", "paper_table1"]
