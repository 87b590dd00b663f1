"""Version and help: there at once, and every option with its comment."""

import subprocess
import sys
from importlib.metadata import version

import pytest
import yaml

import torchrefrac as package
from torchrefrac.cli.conf import CONF, first_comment, read_options

FILES = sorted(CONF.rglob("*.yaml"))
NAMES = [path.relative_to(CONF).as_posix() for path in FILES]
ROOTS = {
    "config.yaml": (),
    **{
        f"{name}.yaml": (name,)
        for name in ("adjust", "calibrate", "correct", "densify", "export", "import", "triangulate")
    },
}


def _leaves(values, name=""):
    """Dotted names of all values of a YAML file, without what it says to Hydra."""
    for key, value in values.items():
        if name or key not in ("defaults", "hydra"):
            if isinstance(value, dict) and value:
                yield from _leaves(value, f"{name}{key}.")
            else:
                yield f"{name}{key}"


def test_the_version_is_the_package_s_own(torchrefrac):
    ended = torchrefrac("--version")

    assert (ended.status, ended.out) == (0, f"torchrefrac {package.__version__}\n")
    assert version("torchrefrac") == package.__version__


@pytest.mark.parametrize("file", NAMES)
def test_every_option_of_every_file_has_a_comment(file):
    options, _ = read_options(CONF / file, "", {})

    assert set(_leaves(yaml.safe_load((CONF / file).read_text()))) <= set(options)
    assert [name for name, option in options.items() if not option.comment] == []


@pytest.mark.parametrize("file", [name for name in NAMES if "/" in name])
def test_every_choice_of_a_group_is_described(file):
    assert first_comment(CONF / file)


@pytest.mark.parametrize("file", ROOTS)
def test_help_shows_each_option_with_default_and_comment_in_a_hundred_columns(torchrefrac, file):
    ended = torchrefrac(*ROOTS[file], "--help")

    assert ended.status == 0
    shown = " ".join(ended.out.split())
    for option in read_options(CONF / file, "", {})[0].values():
        default = "VALUE required:" if option.default == "???" else option.default
        assert f" {option.name}={default} {option.comment}" in shown
    assert max(map(len, ended.out.splitlines())) <= 100


def test_help_shows_the_options_of_the_choice_that_is_given(torchrefrac):
    tank, riverbed = torchrefrac("--help").out, torchrefrac("scene=riverbed", "-h").out

    assert "scene.altitude=" not in tank
    assert "scene.altitude=25.0" in riverbed
    assert "scene.waves.longest=4.0" in riverbed  # the file's own default, the comment of what it changes
    assert "length of the longest wave" in riverbed


def test_help_for_a_choice_that_does_not_exist_names_those_that_do(torchrefrac):
    ended = torchrefrac("scene=pond", "--help")

    assert ended.status != 0
    assert (
        "scene is 'pond', but must be one of aquarium, cans, capture, housing, mesh, riverbed, table, tank, tank_small"
        in ended.err
    )


@pytest.mark.parametrize("argument", ["--help", "--version"])
def test_neither_torch_nor_hydra_is_loaded_for_help_and_version(argument):
    code = (
        "import sys; from torchrefrac.launch import main; main(); "
        "sys.exit(bool({'torch', 'hydra', 'numpy'} & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", code, argument], capture_output=True, text=True, check=False)

    assert (ended.returncode, ended.stderr) == (0, "")
