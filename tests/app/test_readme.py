"""The README's code runs as it stands there; that of all pages is code, and their commands name options that exist."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from torchrefrac.cli.conf import CONF, read_options

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
PAGES = {page.relative_to(ROOT).as_posix(): page for page in (README, *sorted((ROOT / "docs").rglob("*.md")))}
COMMANDS = {page.stem: page for page in CONF.glob("*.yaml")}
BLOCK = re.compile(r"^```python\n(.*?)^```", flags=re.DOTALL | re.MULTILINE)
LINE = re.compile(r"^    (?:\.venv/bin/)?torchrefrac (.*)$", flags=re.MULTILINE)
SPAN = re.compile(r"(?:`|<code>)torchrefrac\s([^`<]*)(?:`|</code>)")


@pytest.fixture
def my_pond(sparse, monkeypatch, tmp_path):
    """The folder of photographs that the README's code reads."""
    shutil.copytree(sparse / "capture", tmp_path / "my_pond")
    monkeypatch.chdir(tmp_path)


def test_the_code_of_the_readme_runs(my_pond, capsys):
    names = {}
    for block in BLOCK.findall(README.read_text(encoding="utf-8")):
        exec(compile(block, "README.md", "exec"), names)

    assert capsys.readouterr().out.startswith("torch.Size([")
    assert names["valid"].all()
    assert names["points"].grad.abs().sum() > 0.0


@pytest.mark.parametrize("name", PAGES)
def test_the_code_of_a_page_is_code(name):
    for block in BLOCK.findall(PAGES[name].read_text(encoding="utf-8")):
        compile(block, name, "exec")


@pytest.mark.parametrize("name", PAGES)
def test_the_commands_of_a_page_name_options_and_choices_that_exist(name):
    text = PAGES[name].read_text(encoding="utf-8")
    commands = [*LINE.findall(text), *SPAN.findall(text)]

    assert {command: unknown for command in commands if (unknown := _unknown(command))} == {}


def test_an_option_that_does_not_exist_is_found():
    assert _unknown("scene=tank scene.deepth=3 dense=patch model=none,pinhole out=there") == [
        "model=pinhole",
        "scene.deepth",
    ]
    assert _unknown("export run=there format=opk form=x") == ["form"]


def _unknown(command):
    """Options of a command that it does not have, and choices of its groups that there are not."""
    words = shlex.split(command, comments=True)
    root = COMMANDS.get(words[0] if words else "", COMMANDS["config"])
    given = dict(word.split("=", 1) for word in words if re.match(r"[a-z_.]+=", word))
    options, groups = read_options(root, "", {})
    known, unknown = set(options), []
    for group in groups:
        every = set(group.choices)
        chosen = set(re.split(r"[,|]", given.pop(group.name))) if group.name in given else set()
        unknown += [f"{group.name}={choice}" for choice in sorted(chosen - every)]
        if group.name == "scene" and not chosen and "sweep" in given:
            chosen = every  # the prepared sweep has one
        for choice in chosen & every:
            known |= set(read_options(root, "", {group.name: choice})[0])
    return unknown + sorted(name for name in given if name not in known and not name.startswith("hydra"))
