"""What is typed, as Hydra hears it."""

import pytest

from torchrefrac.cli.arguments import for_hydra


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
