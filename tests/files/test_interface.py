"""Walls, ports and layers in capture.json, and any interface in cameras.json."""

import json
import math
from dataclasses import replace

import pytest
import torch

import torchrefrac as tr
from tests.files.two_cameras import two_camera_scene
from torchrefrac.files.cameras import read_cameras, write_cameras
from torchrefrac.files.fields import Fields
from torchrefrac.files.interface import interface_of_images, read_interfaces
from torchrefrac.scene import CaptureError, Interfaces

AIR, GLASS, WATER = {"index": 1.0}, {"index": 1.52, "thickness": 1.2}, {"index": 1.333}
WALL = {"kind": "wall", "layers": [AIR, GLASS, WATER]}
PORT = {"kind": "port", "layers": [AIR, GLASS, WATER], "normal_in_cam": [0.0, 0.0, -2.0], "distance": 2.5}


@pytest.fixture
def read(tmp_path):
    """`read(interface)`: what a capture.json with this interface states."""
    return lambda interface: read_interfaces(Fields({"interface": interface}, tmp_path / "capture.json", ""))


def test_a_wall_stands_in_the_world_with_its_glass(read):
    wall = read(WALL)

    assert wall.kinds == ("wall",)
    assert (wall.normal.tolist(), wall.offset.tolist()) == ([[0.0, 0.0, 1.0]], [0.0])
    assert (wall.index_ratio.tolist(), wall.layers.tolist(), wall.thickness.tolist()) == ([1.333], [[1.52]], [[1.2]])
    assert wall.stand_in_world
    assert not wall.move_with_camera
    assert not wall.sigmas


def test_a_port_lies_ahead_of_the_camera_in_its_frame(read):
    port = read(PORT)

    assert (port.normal.tolist(), port.offset.tolist()) == ([[0.0, 0.0, -1.0]], [-2.5])
    assert port.move_with_camera
    assert not port.stand_in_world
    camera = port.of_views(torch.zeros(1, dtype=torch.long))
    assert camera.moves_with_camera
    assert float(camera.plane.signed_distance(torch.zeros(1, 3, dtype=torch.float64))) == 2.5


def test_indices_are_relative_to_the_medium_of_the_camera(read):
    wall = read({"kind": "wall", "layers": [{"index": 1.0003}, GLASS, {"index": 1.333}]})

    assert float(wall.index_ratio) == pytest.approx(1.333 / 1.0003)
    assert float(wall.layers) == pytest.approx(1.52 / 1.0003)


def test_a_surface_may_have_layers_too(read):
    assert read({"layers": [AIR, GLASS, {"index": 1.47, "thickness": 0.5}, WATER]}).thickness.tolist() == [[1.2, 0.5]]


def test_what_is_uncertain_is_named_as_the_adjustment_names_it(read):
    glass = GLASS | {"index_sigma": 0.01, "thickness_sigma": 0.05}
    layers = [AIR, glass, WATER | {"index_sigma": 0.002}]

    port = read(PORT | {"layers": layers, "distance_sigma": 0.5, "tilt_sigma_deg": 2.0})

    assert port.sigmas == {
        "index_ratio": 0.002,
        "layer_index": 0.01,
        "layer_thickness": 0.05,
        "plane_height": 0.5,
        "plane_tilt": pytest.approx(math.radians(2.0)),
    }
    assert read(WALL | {"tilt_sigma_deg": 3.0}).sigmas == {"upright": pytest.approx(math.radians(3.0))}


def test_several_interfaces_have_their_places_and_images_name_theirs(tmp_path):
    side = WALL | {"normal": [0.0, 1.0, 0.0], "offset": 40.0}
    top = {"kind": "surface", "index_ratio": 1.333, "normal": [0.0, 0.0, 1.0], "offset": 0.0}
    images = [{"name": "a", "interface": "side"}, {"name": "b", "interface": "top"}]
    content = Fields({"interfaces": {"top": top, "side": side}, "images": images}, tmp_path / "capture.json", "")

    both = read_interfaces(content)

    assert both.kinds == ("surface", "wall")
    assert both.offset.tolist() == [0.0, 40.0]
    assert both.thickness.tolist() == [[0.0], [1.2]]
    assert interface_of_images(content, content.objects("images")).tolist() == [1, 0]


def test_interfaces_without_a_relation_are_refused(tmp_path):
    top = {"kind": "surface", "index_ratio": 1.333}
    content = Fields({"interfaces": {"top": top, "side": WALL}}, tmp_path / "capture.json", "")

    with pytest.raises(CaptureError, match=r"interfaces\.top\.normal is missing, but several interfaces must"):
        read_interfaces(content)


@pytest.mark.parametrize(
    ("interface", "sentence"),
    [
        ({"kind": "wall", "index_ratio": 1.333}, "index_ratio is not a known field"),
        ({"kind": "port", "layers": [AIR, WATER]}, "normal_in_cam is missing"),
        (PORT | {"normal_in_cam": [0.0, 0.0, 1.0]}, "must point towards the camera"),
        (PORT | {"distance": 0.0}, "distance is 0, but must be above 0"),
        (WALL | {"layers": [AIR, {"index": 1.52}, WATER]}, "thickness is missing"),
        (WALL | {"layers": [AIR, {"index": 0.9, "thickness": 1.0}, WATER]}, "has an index of 0.9 beyond one of 1"),
        (WALL | {"layers": [AIR, GLASS | {"color": "green"}, WATER]}, "color is not a known field"),
        (WALL | {"distance": 2.0}, "distance is not a known field"),
        (WALL | {"tilt_sigma_deg": 90.0}, "tilt_sigma_deg is 90"),
        (WALL | {"layers": [AIR, GLASS | {"index_sigma": 0.1}, GLASS, WATER]}, "only those of one can be used"),
    ],
)
def test_what_cannot_be_right_is_refused_by_name(read, interface, sentence):
    with pytest.raises(CaptureError, match=sentence):
        read(interface)


@pytest.mark.parametrize("kind", ["wall", "port", "tilted"])
def test_cameras_with_any_interface_come_back_and_see_the_same(draw, tmp_path, read, kind):
    scene = two_camera_scene(draw)
    tilted = Interfaces.level(1.34, height=-0.5)
    tilted = replace(tilted, normal=torch.nn.functional.normalize(tilted.normal + 0.01, dim=-1))
    given = {"wall": lambda: read(WALL), "port": lambda: read(PORT), "tilted": lambda: tilted}[kind]()
    scene = replace(scene, interfaces=given)

    write_cameras(scene, tmp_path / "cameras.json")

    assert json.loads((tmp_path / "cameras.json").read_text())["format"] == "torchrefrac-cameras/4"
    again = read_cameras(tmp_path / "cameras.json")
    for name in ("normal", "offset", "index_ratio", "layers", "thickness"):
        torch.testing.assert_close(getattr(again.interfaces, name), getattr(given, name), rtol=0.0, atol=1e-15)
    assert again.interfaces.kinds == given.kinds
    cameras = tr.load_cameras(tmp_path / "cameras.json")
    points = draw.normal(len(cameras.names), 3)
    torch.testing.assert_close(cameras.project(points), scene.camera_of().project(points), rtol=1e-12, atol=1e-9)
