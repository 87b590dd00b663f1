"""`water.json`: planes that survive the file, and files that cannot be right."""

import json
import math
from dataclasses import replace

import pytest
import torch

from tests.files.two_cameras import two_camera_scene
from torchrefrac.files.water import read_water, write_water
from torchrefrac.scene import Interfaces, SceneError

NAMES = ("a.jpg", "b.jpg", "c.jpg")


@pytest.fixture
def content():
    return {
        "format": "torchrefrac-water/1",
        "length_unit": "m",
        "index_ratio": 1.34,
        "planes": [{"normal": [0.0, 0.6, 0.8], "offset": 2.5}, {"normal": [0.0, 0.0, 3.0], "offset": 6.0}],
        "plane_of": {"a.jpg": 0, "b.jpg": 1, "c.jpg": 0},
    }


@pytest.fixture
def read(tmp_path, content):
    """Writes the content with `change` made to it, and reads that for views of these names."""

    def read(change=None, names=NAMES):
        if change is not None:
            change(content)
        (tmp_path / "water.json").write_text(json.dumps(content))
        return read_water(tmp_path / "water.json", names)

    return read


def test_water_survives_the_file_to_the_last_bit(tmp_path, draw):
    ratio = torch.full((20,), 1.3371, dtype=torch.float64)
    water, plane = Interfaces(draw.directions(20), draw.normal(20), ratio), 7 * torch.arange(50) % 20
    scene = two_camera_scene(draw, views=50, points=4)
    scene = replace(scene, interfaces=water, views=replace(scene.views, interface=plane), length_unit="ft")

    write_water(scene, tmp_path / "water.json")
    found, interface = read_water(tmp_path / "water.json", scene.views.names)

    for name in ("normal", "offset", "index_ratio"):
        assert torch.equal(getattr(found, name), getattr(water, name)), name
    assert torch.equal(interface, plane)
    assert json.loads((tmp_path / "water.json").read_text())["length_unit"] == "ft"


def test_surfaces_of_several_index_ratios_have_no_place_in_the_file(tmp_path, draw):
    water = Interfaces(draw.directions(2), draw.normal(2), torch.tensor((1.33, 1.34), dtype=torch.float64))

    with pytest.raises(SceneError, match="have index ratios"):
        write_water(replace(two_camera_scene(draw), interfaces=water), tmp_path / "water.json")


def test_a_normal_of_another_length_means_the_same_plane(read):
    water, _ = read()

    assert water.normal.tolist() == [[0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]
    assert water.offset.tolist() == [2.5, 2.0]


def test_views_find_their_planes_in_any_order(read):
    assert read(names=("b.jpg", "c.jpg", "a.jpg", "b.jpg"))[1].tolist() == [1, 0, 0, 1]


def test_one_plane_is_that_of_every_view(read):
    def one_plane(content):
        del content["planes"][1], content["plane_of"]

    water, interface = read(one_plane, names=("any.jpg", "other.jpg"))

    assert len(water) == 1
    assert interface.tolist() == [0, 0]


def test_a_view_without_a_plane_is_named(read):
    with pytest.raises(SceneError, match=r"plane_of lacks 1 of 2 images, z.jpg first; with 2 planes"):
        read(names=("a.jpg", "z.jpg"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(format="other"), "water.json: format is 'other', but must be 'torchrefrac-water/1'"),
        (lambda c: c.update(index_ratio=0.75), "water.json: index_ratio is 0.75, but n_water / n_air lies between 1"),
        (lambda c: c.update(index_ratio=math.nan), "water.json: index_ratio is nan, but must be finite"),
        (lambda c: c.pop("length_unit"), "water.json: length_unit is missing"),
        (lambda c: c.update(planes=[]), "water.json: planes is empty"),
        (lambda c: c["planes"][1].update(normal=[0, 0, 0]), r"water.json: planes\[1\].normal has length zero"),
        (lambda c: c["planes"][1].update(normal=[0, 1]), r"planes\[1\].normal is a list of 2, but must be a list of 3"),
        (lambda c: c["planes"][0].update(height=3), r"planes\[0\].height is not a known field"),
        (lambda c: c.pop("plane_of"), "water.json: plane_of is missing, but with 2 planes"),
        (lambda c: c["plane_of"].update({"b.jpg": 2}), r"water.json: plane_of\['b.jpg'\] is 2, but must lie in 0 to 1"),
        (lambda c: c["plane_of"].update({"b.jpg": 0.5}), r"plane_of.b.jpg is 0.5, but must be a whole number"),
        (lambda c: c.update(plane_of=[0, 1]), "water.json: plane_of is a list of 2, but must be an object"),
    ],
)
def test_a_file_that_cannot_be_right_is_refused_by_field(read, change, message):
    with pytest.raises(SceneError, match=message):
        read(change)


def test_a_missing_file_and_broken_json_are_named(tmp_path):
    with pytest.raises(SceneError, match=r"water.json is not a file"):
        read_water(tmp_path / "water.json", NAMES)
    (tmp_path / "water.json").write_text('{"format": ')
    with pytest.raises(SceneError, match=r"water.json is not valid JSON"):
        read_water(tmp_path / "water.json", NAMES)
