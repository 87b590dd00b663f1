"""`water.json`: planes that survive the file, and files that cannot be right."""

import json
import math

import pytest
import torch

from torchrefrac.files.water import Water, read_water, write_water
from torchrefrac.scene.alignment import AlignmentError


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
    """Writes the content with `change` made to it, and reads that."""

    def read(change=None):
        if change is not None:
            change(content)
        (tmp_path / "water.json").write_text(json.dumps(content))
        return read_water(tmp_path / "water.json")

    return read


def test_water_survives_the_file_to_the_last_bit(tmp_path, draw):
    water = Water(1.3371, draw.directions(20), draw.normal(20), {f"{i}.jpg": (7 * i) % 20 for i in range(50)}, "ft")

    write_water(water, tmp_path / "water.json")
    loaded = read_water(tmp_path / "water.json")

    assert torch.equal(loaded.normal, water.normal)
    assert torch.equal(loaded.offset, water.offset)
    assert (loaded.index_ratio, loaded.length_unit, dict(loaded.plane_of)) == (1.3371, "ft", water.plane_of)


def test_a_normal_of_another_length_means_the_same_plane(read):
    water = read()

    assert water.normal.tolist() == [[0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]
    assert water.offset.tolist() == [2.5, 2.0]


def test_images_find_their_planes_in_any_order(read):
    assert read().planes_of(("b.jpg", "c.jpg", "a.jpg", "b.jpg")).tolist() == [1, 0, 0, 1]


def test_one_plane_is_that_of_every_image(read):
    def one_plane(content):
        del content["planes"][1], content["plane_of"]

    water = read(one_plane)

    assert dict(water.plane_of) == {}
    assert water.planes_of(("any.jpg", "other.jpg")).tolist() == [0, 0]


def test_an_image_without_a_plane_is_named(read):
    with pytest.raises(AlignmentError, match=r"plane_of lacks 1 of 2 images, z.jpg first; with 2 planes"):
        read().planes_of(("a.jpg", "z.jpg"))


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
    with pytest.raises(AlignmentError, match=message):
        read(change)


def test_a_missing_file_and_broken_json_are_named(tmp_path):
    with pytest.raises(AlignmentError, match=r"water.json is not a file"):
        read_water(tmp_path / "water.json")
    (tmp_path / "water.json").write_text('{"format": ')
    with pytest.raises(AlignmentError, match=r"water.json is not valid JSON"):
        read_water(tmp_path / "water.json")


@pytest.mark.parametrize(
    ("normal", "offset", "message"),
    [
        (torch.zeros(0, 3), torch.zeros(0), "at least one plane"),
        (torch.ones(1, 3), torch.zeros(1), "unit vectors"),
        (torch.full((1, 3), torch.nan), torch.zeros(1), "unit vectors"),
        (torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([torch.inf]), "finite"),
    ],
)
def test_planes_that_are_none_are_refused(normal, offset, message):
    with pytest.raises(AlignmentError, match=message):
        Water(1.333, normal, offset)
