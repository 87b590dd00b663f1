"""What is typed, as Hydra hears it."""

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from torchrefrac.cli.arguments import for_hydra
from torchrefrac.commands import reconstruct as pipeline


@pytest.mark.parametrize("short", ["-q", "--quiet"])
def test_q_is_short_for_quiet(short):
    assert for_hydra([short, "model=none"]) == ["quiet=true", "model=none"]


def test_in_a_sweep_the_options_of_a_group_are_left_to_the_jobs():
    given = ["-m", "scene=tank,cans", "scene.depth=50", "scene.heights=[30,40]", "seed=3", "out=there"]

    heard = ["-m", "scene=tank,cans", "scene.depth=choice(50)", "scene.heights=choice([30,40])", "seed=3", "out=there"]
    assert for_hydra(given) == heard


def test_so_they_are_in_a_sweep_that_is_prepared():
    assert for_hydra(["sweep=depth", "scene.camera.width=320"]) == ["sweep=depth", "scene.camera.width=choice(320)"]


@pytest.mark.parametrize(
    "argument",
    [
        "scene.depth=50,60",
        "scene.depth=range(50,90)",
        "~scene.depth",
        "hydra.launcher.n_jobs=2",
        "scene.depth=(",
        "--cfg",
    ],
)
def test_what_varies_is_taken_out_belongs_to_hydra_or_is_wrong_stays_as_it_is(argument):
    assert for_hydra(["-m", argument]) == ["-m", argument]


def test_a_single_run_hears_what_was_typed():
    given = ["scene=tank", "scene.depth=50"]

    assert for_hydra(given) == given


def test_an_option_that_only_one_swept_scene_has_concerns_that_one_alone(torchrefrac, part_of_tank):
    folder = part_of_tank([0, 1])

    ended = torchrefrac("-m", "scene=capture,tank_small", f"scene.path={folder}", "seed=abc", "out=runs")

    assert ended.status == 1
    assert ended.err.count("error: seed is 'abc', but must be a whole number") == 2
    assert "torchrefrac -m scene=capture,tank_small" in ended.out
    assert f"scene.path={folder}" in ended.out
    assert "choice(" not in ended.out


@pytest.mark.parametrize(
    "folder", ["Überflug_湖", "H=40m", "a (1)", "2024", "1e3", "true", "a, b", "[x]", "it's", "#1!"]
)
@pytest.mark.parametrize("option", ["scene.path", "out", "run", "alignment", "capture", "water.path", "+cache"])
def test_folders_may_have_any_name(folder, option):
    (heard,) = for_hydra([f"{option}={folder}"])

    (override,) = OverridesParser.create().parse_overrides([heard])
    assert override.value() == folder
    assert not override.is_sweep_override()


@pytest.mark.parametrize(
    "value", ["runs/pond", "null", "outputs/${now:%Y}_x", "'a (1)'", "a\\ \\(1\\)", "", "../x-1.2"]
)
def test_names_that_hydra_understands_stay_as_they_are(value):
    assert for_hydra([f"out={value}"]) == [f"out={value}"]


def test_the_folder_of_the_user_is_found(monkeypatch):
    monkeypatch.setenv("HOME", "/home/a b")

    assert for_hydra(["scene.path=~/pond", "out=~/pond"]) == ["scene.path=/home/a b/pond", "out=/home/a b/pond"]


@pytest.mark.parametrize(
    ("given", "heard"),
    [
        ("scene.path=2023,2024", "scene.path='2023','2024'"),
        ("scene.path=a (1),b", "scene.path='a (1)',b"),
        ("scene.path=a,b", "scene.path=a,b"),
        ("scene.path=choice(a,b)", "scene.path=choice(a,b)"),
        ("scene.path=a (1)", "scene.path=choice('a (1)')"),
        ("out=a (1)", "out='a (1)'"),
    ],
)
def test_in_a_sweep_several_folders_are_separated_by_commas(given, heard):
    assert for_hydra(["-m", given]) == ["-m", heard]


@pytest.mark.parametrize("name", ["Überflug_湖", "H=40m", "a (1)", "2024"])
def test_a_capture_is_found_in_a_folder_of_such_a_name(torchrefrac, part_of_tank, tmp_path, metrics, monkeypatch, name):
    part_of_tank([0, 1]).rename(tmp_path / name)
    monkeypatch.setattr(pipeline, "reconstruct", _stop)

    ended = torchrefrac("scene=capture", f"scene.path={name}", f"out=runs {name}")

    assert ended.err.splitlines()[-1] == "error: here"
    assert metrics(tmp_path / f"runs {name}")["capture"] == str(tmp_path / name)
    assert metrics(tmp_path / f"runs {name}")["overrides"]["scene.path"] == name


def _stop(*_):
    raise pipeline.ReconstructionError("here")
