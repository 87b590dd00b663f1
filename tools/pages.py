"""Run the examples and write each as a page and as a notebook, with what it printed and drew.

python -m tools.pages [NAME ...], from the root of the repository; by default all that lie in examples/

docs/examples/NAME.md has the script function by function, all of it and in its order; NAME.ipynb beside it is the same
for Jupyter. Pictures are those that the script leaves in outputs/NAME.
"""

import argparse
import ast
import base64
import json
import os
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

EXAMPLES, PAGES = Path("examples"), Path("docs/examples")
FENCE = "```"
MIME = {".png": "image/png", ".jpg": "image/jpeg"}


class Part(NamedTuple):
    """Some lines of a script: one function or class, or all before the first, which has no name."""

    name: str
    code: str


class Script(NamedTuple):
    """An example: what it is about, in a line and at length, and its parts."""

    title: str
    text: str
    parts: list[Part]

    @classmethod
    def of(cls, source: str) -> "Script":
        """Raises ValueError for a script without a docstring."""
        tree = ast.parse(source)
        docstring = ast.get_docstring(tree)
        if docstring is None:
            raise ValueError("an example begins with a docstring, but this one has none")
        title, _, text = docstring.partition("\n\n")
        lines = source.splitlines()
        named = [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        rows = [node.decorator_list[0].lineno if node.decorator_list else node.lineno for node in named]
        starts = [(tree.body[0].end_lineno or 0) + 1, *rows, len(lines) + 1]
        names = ["", *(node.name for node in named)]
        code = ["\n".join(lines[a - 1 : b - 1]).strip("\n") for a, b in pairwise(starts)]
        return cls(title.rstrip("."), text, [Part(*part) for part in zip(names, code, strict=True)])


class Outcome(NamedTuple):
    """What running a script left behind: its lines, the content of its pictures by their names, and seconds."""

    printed: str
    pictures: dict[str, bytes]
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description="Run the examples and write their pages.")
    parser.add_argument("names", nargs="*", help="of scripts in examples/, by default all")
    names = parser.parse_args().names or sorted(path.stem for path in EXAMPLES.glob("*.py"))
    PAGES.mkdir(parents=True, exist_ok=True)
    for name in names:
        script = Script.of((EXAMPLES / f"{name}.py").read_text(encoding="utf-8"))
        outcome = run(name)
        for picture, content in outcome.pictures.items():
            (PAGES / picture).write_bytes(content)
        (PAGES / f"{name}.md").write_text(page(name, script, outcome), encoding="utf-8")
        notebook_text = json.dumps(notebook(name, script, outcome), indent=1, ensure_ascii=False)
        (PAGES / f"{name}.ipynb").write_text(notebook_text + "\n", encoding="utf-8")
        print(f"{name}: {outcome.seconds:.0f} s of a processor")


def run(name: str) -> Outcome:
    """Run an example in an empty folder, on one thread. Raises CalledProcessError where it fails."""
    command = [sys.executable, str((EXAMPLES / f"{name}.py").resolve())]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path.cwd())}
    with tempfile.TemporaryDirectory() as folder:
        before = os.times()
        done = subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        after = os.times()
        left = (Path(folder) / "outputs" / name).glob("*")
        pictures = sorted(path for path in left if path.suffix in MIME)
        seconds = after.children_user + after.children_system - before.children_user - before.children_system
        return Outcome(done.stdout, {path.name: path.read_bytes() for path in pictures}, seconds)


def page(name: str, script: Script, outcome: Outcome) -> str:
    """As markdown."""
    usage, _, text = script.text.partition("\n\n")
    minutes = time.strftime("%-M:%S", time.gmtime(outcome.seconds))
    pictures = "".join(f"![What {name}.py draws]({picture})\n\n" for picture in outcome.pictures)
    parts = "\n\n".join(
        (f"### {part.name}\n\n" if part.name else "") + f"{FENCE}python\n{part.code}\n{FENCE}" for part in script.parts
    )
    return (
        f"# {script.title}\n\n{usage}\n\n{text}\n\n{FENCE}text\n{outcome.printed.rstrip()}\n{FENCE}\n\n{pictures}"
        f"{minutes} minutes of one processor core. [As a notebook]({name}.ipynb).\n\n## The script\n\n{parts}\n"
    )


def code_of(page: str) -> str:
    """The script of a page, without its docstring and empty lines between its parts."""
    blocks = page.split(f"{FENCE}python\n")[1:]
    return "\n".join(block.partition(f"\n{FENCE}")[0] for block in blocks)


def notebook(name: str, script: Script, outcome: Outcome) -> dict[str, Any]:
    """As a notebook of format 4.5, whose last cell has what was printed and drawn."""
    first, *rest = (part.code for part in script.parts)
    code = [f'import sys\n\nsys.argv = ["{name}.py"]\nsys.path.append("../../examples")', first, *rest]
    cells: list[dict[str, Any]] = [
        {"cell_type": "markdown", "id": "text", "metadata": {}, "source": f"# {script.title}\n\n{script.text}"},
        *(
            {
                "cell_type": "code", "id": f"part-{row}", "metadata": {}, "source": source, "outputs": [],
                "execution_count": row + 1,
            }
            for row, source in enumerate(code)
        ),
    ]  # fmt: skip
    shown: list[dict[str, Any]] = [{"output_type": "stream", "name": "stdout", "text": outcome.printed}]
    for picture, content in outcome.pictures.items():
        encoded = {MIME[Path(picture).suffix]: base64.b64encode(content).decode("ascii")}
        shown.append({"output_type": "display_data", "data": encoded, "metadata": {}})
    cells[-1]["outputs"] = shown
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


if __name__ == "__main__":
    main()
