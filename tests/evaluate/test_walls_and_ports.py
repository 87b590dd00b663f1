"""What metrics say of walls and ports, beside what they say of any scene."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.evaluate.metrics import summarize
from torchrefrac.geometry import Rigid, so3_exp
from torchrefrac.scene import Assessment, Capture, Interfaces, Observations, Scene

DOUBLE = torch.float64
COUNT = 5


def _table(*rows):
    return torch.tensor(rows, dtype=DOUBLE)


@pytest.fixture
def through(draw, tmp_path):
    """`through(kind, normal, offset)`: five views anywhere, with gravity along -y to 0.5 degrees and without error, and
    what they look through."""

    def make(kind, normal, offset):
        interfaces = Interfaces(
            _table(normal), _table(offset), _table(1.333), _table((1.52,)), _table((0.8,)), kinds=(kind,)
        )
        rotation, none = so3_exp(draw.normal(COUNT, 3)), torch.zeros(0, 3, dtype=DOUBLE)
        lens, names = Intrinsics.create(640, 480, 400.0), tuple(f"{i}.jpg" for i in range(COUNT))
        scene = Scene.create(
            Rigid(rotation, draw.normal(COUNT, 3)), lens, interfaces, none, Observations.none(), length_unit="cm"
        )
        capture = Capture(
            folder=tmp_path, names=names, paths=tuple(tmp_path / name for name in names), cameras=scene.cameras,
            interfaces=interfaces, down_in_cam=rotation @ _table(0.0, -1.0, 0.0),
            down_sigma=torch.full((COUNT,), math.radians(0.5), dtype=DOUBLE), height=torch.zeros(COUNT, dtype=DOUBLE),
            has_height=torch.zeros(COUNT, dtype=torch.bool), length_unit="cm",
        )  # fmt: skip
        return replace(scene, capture=capture)

    return make


def test_a_wall_s_angle_from_upright_is_that_of_its_normal_to_the_level(through):
    off = math.radians(2.0)

    metrics = summarize(through("wall", (0.0, math.sin(off), math.cos(off)), 0.0))

    assert metrics["interface"] == "wall"
    assert metrics["wall_upright_off_deg"] == pytest.approx(2.0)
    assert metrics["wall_upright_sigma_deg"] == pytest.approx(0.5 / math.sqrt(COUNT))


def test_what_was_found_of_a_port_has_its_standard_deviation(through):
    tilt = math.radians(1.5)
    scene = through("port", (0.0, math.sin(tilt), -math.cos(tilt)), -2.1)
    deviations = {"tilt_sigma": math.radians(0.02), "layer_sigma": {"layer_thickness": 0.03}}
    known = Assessment(level_covariance=_table((0.04**2,)), **deviations)

    as_stated = summarize(scene)
    found = summarize(replace(scene, assessment=known))

    assert not [name for name in as_stated if name.startswith(("port", "wall", "glass"))]
    assert found["interface"] == "port"
    assert found["port_distance_cm"] == pytest.approx(2.1)
    assert found["port_distance_sigma_cm"] == pytest.approx(0.04)
    assert found["port_tilt_deg"] == pytest.approx(1.5)
    assert found["port_tilt_sigma_deg"] == pytest.approx(0.02)
    assert found["glass_thickness_cm"] == 0.8
    assert found["glass_thickness_sigma_cm"] == 0.03
    assert "glass_index" not in found


def test_a_surface_of_water_has_no_such_metrics(through):
    metrics = summarize(through("surface", (0.0, 0.0, 1.0), 0.0))

    assert not [name for name in metrics if name.startswith(("interface", "port", "wall", "glass"))]


def test_sentences_are_about_what_was_looked_through(through):
    scene = through("port", (0.0, 0.0, -1.0), -2.0)
    sentences = ("tilt of the water to the cameras: determined to 0.1 degrees",)
    held = {"plane_height": "height of cameras above the water, relative: not determined"}

    metrics = summarize(replace(scene, assessment=Assessment(determined=sentences, fixed=held)))

    assert metrics["determined"] == ["tilt of the port: determined to 0.1 degrees"]
    assert metrics["held"] == {"plane_height": "distance of the port, relative: not determined"}
