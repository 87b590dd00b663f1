"""Photographs that the pairs which were chosen do not join are matched with others, too."""

import pytest
import torch

from torchrefrac.commands import reconstruct as pipeline
from torchrefrac.commands.pairs import ChosenPairs
from torchrefrac.config import Options
from torchrefrac.features import MatchOptions
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene

FEW = [0, 1, 2, 3]


@pytest.fixture
def four_images():
    return load_capture(embedded_scene("tank_small")).of_views(FEW)


def test_a_photograph_without_partners_is_registered_after_all(four_images, monkeypatch):
    triangle = torch.tensor([[0, 1], [0, 2], [1, 2]])
    monkeypatch.setattr(pipeline, "choose_pairs", lambda *about: ChosenPairs(triangle, "retrieval", 4))

    scene = pipeline.reconstruct(four_images)

    assert bool(scene.views.registered.all())
    assert not scene.failures


def test_a_list_of_pairs_is_all_that_is_matched(four_images, tmp_path):
    listed = tmp_path / "pairs.txt"
    names = four_images.names
    listed.write_text(f"{names[0]} {names[1]}\n{names[0]} {names[2]}\n{names[1]} {names[2]}\n", encoding="utf-8")

    scene = pipeline.reconstruct(four_images, Options(matching=MatchOptions(pairs=str(listed))))

    assert scene.views.registered.tolist() == [True, True, True, False]
