"""Options: every YAML file composes into the typed schema, and what is wrong is named."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from torchrefrac.cli.composed import run_options
from torchrefrac.cli.conf import CONF
from torchrefrac.config import OptionError, Options, WaterOptions, build
from torchrefrac.refraction import water_index

GROUPS = sorted(
    str(path.relative_to(CONF).with_suffix(""))
    for path in CONF.glob("*/*.yaml")
    if path.parent.name != "rendering"  # a part of the scenes that are made
)
MISSING = {
    "scene/capture": ["scene.path=somewhere"], "scene/mesh": ["scene.file=some.ply"], "outputs/survey": ["dense=patch"],
    "matching/lightglue": ["features=kornia_disk"], "features/file": ["features.path=some.db"], "executor/dask": ["executor.address=tcp://there:8786"],
}  # fmt: skip


def _compose(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides))


@pytest.mark.parametrize("choice", GROUPS)
def test_every_yaml_composes_into_typed_options(choice):
    group, name = choice.split("/")

    options = run_options(_compose(f"{group}={name}", "out=there", *MISSING.get(choice, [])))

    assert options.output.out == "there"


def test_the_yaml_defaults_are_those_of_the_typed_options():
    assert run_options(_compose("out=there")).reconstruction == Options()


def test_a_yaml_that_is_not_in_a_group_is_the_root_of_a_command():
    commands = ("adjust", "calibrate", "config", "correct", "densify", "export", "import", "triangulate")
    assert sorted(path.stem for path in Path(CONF).glob("*.yaml")) == list(commands)


def test_the_water_group_sets_the_index_ratio():
    ratios = {name: run_options(_compose(f"water={name}")).reconstruction.water for name in ("fresh", "sea", "air")}
    assert ratios == {"fresh": WaterOptions(1.333), "sea": WaterOptions(1.34), "air": WaterOptions(1.0)}


def test_the_index_ratio_can_come_from_the_temperature_of_the_water():
    water = run_options(_compose("water=measured", "water.temperature_c=12")).reconstruction.water

    assert water.ratio_of(1.5) == pytest.approx(float(water_index(12.0, 0.0, 550.0)))


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"sede": 1}, "sede is not an option; known here are model, water"),
        ({"seed": 1.5}, "seed is 1.5, but must be a whole number"),
        ({"seed": True}, "seed is True, but must be a whole number"),
        ({"sfm": 3}, "sfm is 3, but must be a group of options"),
        ({"sfm": {"max_error": "big"}}, "sfm.max_error is 'big', but must be a number"),
        ({"sfm": {"ransac": {"confidnce": 1}}}, "sfm.ransac.confidnce is not an option"),
        ({"sfm": {"ransac": {"max_error": -1.0}}}, "sfm.ransac.max_error is -1, but must be finite and above 0"),
        (
            {"model": {"name": "perspective"}},
            "model.name is 'perspective', but must be one of none, radial, bundler, refractive",
        ),
        ({"water": {"index_ratio": 0.5}}, "water.index_ratio is 0.5, but must lie between 1 and 3"),
        (
            {"water": {"temperature_c": 60.0}},
            "water.temperature_c is 60, but must be finite and at least 0 and at most 30",
        ),
        (
            {"water": {"index_ratio": 1.3, "temperature_c": 9.0}},
            "water.index_ratio and water.temperature_c are both given",
        ),
        ({"water": {"index_ratio": "wet"}}, "water.index_ratio is 'wet', but must be a number"),
    ],
)
def test_a_wrong_option_is_named(values, sentence):
    with pytest.raises(OptionError, match=sentence):
        build(Options, values)


def test_a_whole_number_serves_as_a_float():
    assert build(Options, {"sfm": {"max_error": 3}}).sfm.max_error == 3.0
