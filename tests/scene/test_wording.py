"""What is said of a surface of water, a wall and a port, by what photographs look through."""

from dataclasses import fields, replace

import pytest
import torch

from torchrefrac.bundle.observability import WORDS
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Interfaces, Observations, Scene
from torchrefrac.scene.interfaces import KINDS, PORT, SURFACE, WALL
from torchrefrac.scene.wording import OF_WATER, kind_of, wording, wording_of


@pytest.fixture
def through():
    """`through(kind)`: a scene of one view that looks through such an interface."""

    def make(kind):
        towards = -1.0 if kind == PORT else 1.0
        one = replace(Interfaces.level(1.333), kinds=(kind,))
        interfaces = replace(one, normal=towards * one.normal, offset=one.offset + min(towards, 0.0))
        none = torch.zeros(0, 3, dtype=torch.float64)
        lens = Intrinsics.create(640, 480, 400.0)
        return Scene.create(Rigid.identity(1), lens, interfaces, none, Observations.none())

    return make


@pytest.mark.parametrize("kind", KINDS)
def test_words_are_those_of_what_a_scene_looks_through(through, kind):
    assert kind_of(through(kind)) == kind
    assert wording_of(through(kind), {}).kind == kind


def test_a_run_without_refraction_is_described_by_what_its_metrics_say_was_looked_through(through):
    scene = replace(through(SURFACE), interfaces=Interfaces.level(1.0))

    assert wording_of(scene, {}).kind == SURFACE
    assert wording_of(scene, {"interface": "wall"}).kind == WALL


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("kind", [WALL, PORT])
def test_nothing_is_said_of_water_levels_where_there_are_none(kind, upright):
    words = wording(kind, upright)

    texts = [getattr(words, field.name) for field in fields(words) if field.name not in {"kind", "quantities"}]
    assert all(isinstance(text, str) for text in texts)
    assert not [text for text in texts if "water" in text]


def test_only_what_is_upright_shows_which_way_is_up(through):
    assert wording(WALL).y == "y"
    assert wording(WALL, upright=True).y == "y, up"
    assert wording_of(through(WALL), {"gravity": "measured"}).y == "y, up"
    assert wording_of(through(PORT), {"gravity": "unknown"}).z == "z"
    assert wording_of(through(PORT), {}, upright=True).z == "height"


def test_scale_follows_from_glass_only_where_there_is_some(through):
    scene = through(WALL)
    thickness = torch.ones(1, 1, dtype=torch.float64)
    glazed = replace(scene.interfaces, layers=1.52 * thickness, thickness=thickness)

    assert wording_of(scene, {}).scale == OF_WATER.scale
    assert "thickness of the glass" in wording_of(replace(scene, interfaces=glazed), {}).scale


def test_quantities_of_an_adjustment_are_called_by_the_kind():
    tilt = f"{WORDS['plane_tilt']}: determined to 0.01 degrees"
    height = f"{WORDS['plane_height']}: not determined"

    assert [OF_WATER.of_quantity(words) for words in (tilt, height)] == [tilt, height]
    assert wording(WALL).of_quantity(tilt) == "tilt of the glass to the cameras: determined to 0.01 degrees"
    assert wording(WALL).of_quantity(height) == "distance of cameras from the glass, relative: not determined"
    assert wording(PORT).of_quantity(tilt) == "tilt of the port: determined to 0.01 degrees"
    assert wording(PORT).of_quantity(height) == "distance of the port, relative: not determined"
    assert wording(PORT).of_quantity("index ratio: determined to 0.1") == "index ratio: determined to 0.1"
