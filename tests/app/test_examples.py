"""The examples that come with the package, run as a reader would."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import torchrefrac

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
RATIO = 1.33  # of the embedded scene, whose water level is 0


def _module(name):
    """That of an example."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def example():
    """The module of examples/learn_water.py."""
    return _module("learn_water")


def test_a_few_steps_move_the_guess_of_the_index_ratio_towards_the_truth(example, monkeypatch, capsys):
    monkeypatch.setattr(example, "BLURS", (12.0,))
    monkeypatch.setattr(example, "PIXELS", 500)
    images, cameras, boards, _ = example.load()
    guess = torchrefrac.FlatInterface(1.25, plane=torchrefrac.Plane(offset=3.0))
    model = torchrefrac.LearnableCamera(replace(cameras, interface=guess))

    example.learn_water(model, images, boards, steps=20)

    reports = _reports(capsys.readouterr().out)
    assert reports[0] == (1.25, 3.0)
    assert abs(reports[-1][0] - RATIO) < 0.7 * abs(1.25 - RATIO)


@pytest.mark.slow
def test_the_water_is_learnt_from_images(example, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["learn_water.py"])

    example.main()

    *_, learnt, truth = _reports(capsys.readouterr().out)
    assert truth == (RATIO, 0.0)
    assert abs(learnt[0] - RATIO) < 0.002
    assert abs(learnt[1]) < 0.1


def _reports(printed):
    """Index ratio and water level of every line."""
    return [(float(words[-5]), float(words[-2])) for words in map(str.split, printed.splitlines())]
