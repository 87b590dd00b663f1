"""Results on disk: written whole or not at all, and read back as they were."""

import json
from dataclasses import replace

import pytest
import torch
import trimesh

from torchrefrac.atomic import replacing
from torchrefrac.camera import Intrinsics
from torchrefrac.files.cameras import load_cameras, load_points, write_cameras, write_points
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.scene import Assessment, CaptureError, Reconstruction


@pytest.fixture
def reconstruction(draw):
    empty = torch.zeros(0, dtype=torch.long)
    return Reconstruction(
        names=("a.png", "b.png"),
        registered=torch.tensor([True, False]),
        rotation=draw.rotations(2),
        center=draw.normal(2, 3),
        intrinsics=Intrinsics.create(64, 48, 50.0, distortion=(0.1, 0.2, 0.3, 0.4, 0.5)),
        index_ratio=1.333,
        length_unit="cm",
        points=torch.zeros(0, 3, dtype=torch.float64),
        colors=torch.zeros(0, 3, dtype=torch.uint8),
        image=empty,
        point=empty,
        pixels=torch.zeros(0, 2, dtype=torch.float64),
        failures={"b.png": "sees nothing"},
    )


def test_cameras_survive_the_file_to_the_last_bit(tmp_path, reconstruction):
    write_cameras(reconstruction, tmp_path / "cameras.json")
    loaded = load_cameras(tmp_path / "cameras.json")
    assert loaded.names == reconstruction.names
    assert loaded.failures == reconstruction.failures
    assert torch.equal(loaded.registered, reconstruction.registered)
    assert torch.equal(loaded.rotation[0], reconstruction.rotation[0])
    assert torch.equal(loaded.center[0], reconstruction.center[0])
    assert torch.equal(loaded.intrinsics.distortion, reconstruction.intrinsics.distortion)
    assert (loaded.index_ratio, loaded.length_unit) == (1.333, "cm")


def test_covariances_of_centres_survive_the_file_to_the_last_bit(tmp_path, draw, reconstruction):
    half = draw.normal(1, 3, 3)
    covariance = half @ half.mT
    known = Assessment(center_covariance=covariance)

    write_cameras(replace(reconstruction, assessment=known), tmp_path / "cameras.json")
    told = load_cameras(tmp_path / "cameras.json").assessment

    assert torch.equal(told.center_covariance, covariance)
    assert float(told.center_sigma) == pytest.approx(float(covariance[0].trace() / 3.0) ** 0.5)


def test_without_covariances_nothing_is_known_of_the_centres(tmp_path, reconstruction):
    write_cameras(reconstruction, tmp_path / "cameras.json")

    assert load_cameras(tmp_path / "cameras.json").assessment == Assessment()


def test_an_unregistered_image_has_a_reason_and_no_pose(tmp_path, reconstruction):
    write_cameras(reconstruction, tmp_path / "cameras.json")
    entry = json.loads((tmp_path / "cameras.json").read_text())["images"][1]
    assert entry == {"name": "b.png", "registered": False, "reason": "sees nothing"}


@pytest.mark.parametrize("count", [1, 100])
def test_points_and_colours_survive_the_file(tmp_path, draw, count):
    points = draw.normal(count, 3)
    colors = torch.randint(256, (count, 3), dtype=torch.uint8)
    write_points(points, colors, tmp_path / "points.ply")
    loaded, loaded_colors = load_points(tmp_path / "points.ply")
    assert torch.allclose(loaded, points, rtol=1e-6)
    assert torch.equal(loaded_colors, colors)


@pytest.mark.parametrize("count", [0, 1, 100])
def test_standard_deviations_of_points_are_a_property_of_the_vertices(tmp_path, draw, count):
    points, colors = draw.normal(count, 3), torch.randint(256, (count, 3), generator=draw.generator).to(torch.uint8)
    sigma = draw.power_of_ten(-6.0, 3.0, count)

    write_points(points, colors, tmp_path / "points.ply", sigma)

    vertices = _raw_ply(tmp_path / "points.ply")["vertex"]
    assert list(vertices["properties"].items()) == [
        *((name, "<f4") for name in "xyz"),
        *((name, "<u1") for name in ("red", "green", "blue")),
        ("sigma", "<f4"),
    ]
    assert vertices["length"] == count
    if count:
        assert torch.equal(torch.from_numpy(vertices["data"]["sigma"].copy()).flatten(), sigma.float())
        assert torch.equal(torch.from_numpy(vertices["data"]["z"].copy()).flatten(), points[:, 2].float())
        loaded, loaded_colors = load_points(tmp_path / "points.ply")
        assert torch.allclose(loaded, points, rtol=1e-6)
        assert torch.equal(loaded_colors, colors)


def test_points_without_them_have_no_such_property(tmp_path, draw):
    write_points(draw.normal(3, 3), torch.zeros(3, 3, dtype=torch.uint8), tmp_path / "points.ply")

    assert "sigma" not in _raw_ply(tmp_path / "points.ply")["vertex"]["properties"]


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "result.json"
    target.write_text("old")

    def write_half():
        with replacing(target) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]
    assert target.read_text() == "old"


def test_a_write_that_succeeds_replaces_the_file(tmp_path):
    target = tmp_path / "deeper" / "result.json"
    with replacing(target) as temporary:
        temporary.write_text("new")
        assert not target.exists()
    assert [p.name for p in target.parent.iterdir()] == ["result.json"]


def test_truth_of_the_embedded_scene_is_consistent():
    truth = load_truth(embedded_scene("tank_small"))
    assert truth is not None
    assert len(truth.names) == 8
    assert torch.allclose(truth.rotation @ truth.rotation.mT, torch.eye(3, dtype=torch.float64).expand(8, 3, 3))
    assert torch.allclose(truth.normal[0], torch.tensor([0, 0, 1], dtype=torch.float64))


def test_no_truth_is_no_error(tmp_path):
    assert load_truth(tmp_path) is None


def test_a_mistyped_truth_is_named(tmp_path):
    (tmp_path / "truth.json").write_text(
        json.dumps({"length_unit": "cm", "images": [{"name": "a", "cam_from_world_rotation": [[1, 0], [0, 1]]}]})
    )
    with pytest.raises(CaptureError, match=r"images\[0\].cam_from_world_rotation is a list of 2"):
        load_truth(tmp_path)


def _raw_ply(path):
    """The elements of a PLY file as they are in it, by name."""
    return trimesh.load(path, process=False).metadata["_ply_raw"]
