"""The README's code runs as it stands there."""

import re
import shutil
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[2] / "README.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


@pytest.fixture
def my_pond(sparse, monkeypatch, tmp_path):
    """The folder of photographs that the README's code reads."""
    shutil.copytree(sparse / "capture", tmp_path / "my_pond")
    monkeypatch.chdir(tmp_path)


def test_the_code_of_the_readme_runs(my_pond, capsys):
    names = {}
    for block in BLOCKS:
        exec(compile(block, "README.md", "exec"), names)

    assert capsys.readouterr().out.startswith("torch.Size([")
    assert names["valid"].all()
    assert names["points"].grad.abs().sum() > 0.0
