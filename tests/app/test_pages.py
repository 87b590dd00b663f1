"""The pages of the examples show the scripts as they are."""

import json
from pathlib import Path

import pytest

from tools.pages import FENCE, Outcome, Part, Script, code_of, notebook, page

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs/examples"
NAMES = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))
OUTCOME = Outcome("3 cm\n", {"a.png": b"drawn"}, 75.0)
SOURCE = '''"""Add two lengths.

    python examples/add.py

They are in cm.
"""

import sys

ONE = 1


@staticmethod
def two() -> int:
    return 2


class Three:
    pass


if __name__ == "__main__":
    print(ONE + two(), "cm")
'''


def test_a_script_falls_into_its_functions_and_classes():
    script = Script.of(SOURCE)

    assert script.title == "Add two lengths"
    assert script.text.endswith("They are in cm.")
    assert script.parts == [
        Part("", "import sys\n\nONE = 1"),
        Part("two", "@staticmethod\ndef two() -> int:\n    return 2"),
        Part("Three", 'class Three:\n    pass\n\n\nif __name__ == "__main__":\n    print(ONE + two(), "cm")'),
    ]


def test_a_script_without_a_docstring_is_refused():
    with pytest.raises(ValueError, match="docstring"):
        Script.of("x = 1\n")


def test_a_page_has_text_output_pictures_and_time():
    text = page("add", Script.of(SOURCE), OUTCOME)

    for wanted in ("# Add two lengths\n", "They are in cm.", f"{FENCE}text\n3 cm\n{FENCE}", "](a.png)", "1:15 minutes"):
        assert wanted in text


def test_a_notebook_ends_with_what_was_printed_and_drawn():
    cells = notebook("add", Script.of(SOURCE), OUTCOME)["cells"]

    printed, drawn = cells[-1]["outputs"]
    assert printed["text"] == "3 cm\n"
    assert drawn["data"] == {"image/png": "ZHJhd24="}


@pytest.mark.parametrize("name", NAMES)
def test_page_and_notebook_have_the_code_of_the_script(name):
    script = Script.of((ROOT / f"examples/{name}.py").read_text(encoding="utf-8"))
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    cells = json.loads((PAGES / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]

    assert code_of(text) == "\n".join(part.code for part in script.parts), "run make examples"
    assert [cell["source"] for cell in cells[2:]] == [part.code for part in script.parts], "run make examples"
    assert text.startswith(f"# {script.title}\n")
    assert f"examples/{name}.md" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
