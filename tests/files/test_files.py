"""Results on disk: written whole or not at all, and read back as they were."""

import json
import math
from dataclasses import replace

import pytest
import torch
import trimesh

from torchrefrac.atomic import replacing
from torchrefrac.camera import Intrinsics
from torchrefrac.files.cameras import load_cameras, load_points, read_cameras, write_cameras, write_points
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.ply import read_vertices
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Rigid
from torchrefrac.scene import (
    Assessment,
    Cameras,
    CaptureError,
    Georeference,
    Interfaces,
    Observations,
    Scene,
    SceneError,
)

CAMERAS_JSON = """{
    "format": "torchrefrac-cameras/1", "length_unit": "cm", "index_ratio": 1.333, "pixel_origin": "corner",
    "intrinsics": {
        "width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0,
        "distortion": [0.1, 0.2, 0.3, 0.4, 0.5]
    },
    "images": [
        {
            "name": "a.png", "registered": true,
            "cam_from_world_rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            "center_in_world": [0.0, 1.0, 2.0]
        },
        {"name": "b.png", "registered": false, "reason": "sees nothing"}
    ]
}"""


@pytest.fixture
def scene(draw):
    intrinsics = Intrinsics.create(64, 48, 50.0, distortion=(0.1, 0.2, 0.3, 0.4, 0.5))
    scene = Scene.create(
        Rigid(draw.rotations(2), draw.normal(2, 3)),
        intrinsics,
        Interfaces.level(1.333),
        torch.zeros(0, 3, dtype=torch.float64),
        Observations.none(),
        names=("a.png", "b.png"),
        length_unit="cm",
    )
    views = replace(scene.views, registered=torch.tensor([True, False]))
    return replace(scene, views=views, failures={"b.png": "sees nothing"})


def test_where_the_frame_stands_survives_the_file(tmp_path, scene):
    place = Georeference("EPSG:32633", (412345.0, 5312345.0, 431.25), "EPSG:5773", 0.9996267853446436)
    write_cameras(replace(scene, georeference=place, length_unit="m"), tmp_path / "cameras.json")
    assert read_cameras(tmp_path / "cameras.json").georeference == place
    assert "slope" not in json.loads((tmp_path / "cameras.json").read_text())["georeference"]
    sloping = replace(place, slope=(0.0018, -0.0009))
    write_cameras(replace(scene, georeference=sloping, length_unit="m"), tmp_path / "cameras.json")
    assert read_cameras(tmp_path / "cameras.json").georeference == sloping
    steep = replace(place, slope=(1.8, 0.0))
    write_cameras(replace(scene, georeference=steep, length_unit="m"), tmp_path / "cameras.json")
    with pytest.raises(SceneError, match=r"georeference.slope is \[1.8, 0.0\], but water rises by 1 per metre at most"):
        read_cameras(tmp_path / "cameras.json")


def test_cameras_survive_the_file_to_the_last_bit(tmp_path, scene):
    write_cameras(scene, tmp_path / "cameras.json")
    loaded = read_cameras(tmp_path / "cameras.json")
    assert loaded.views.names == scene.views.names
    assert loaded.failures == scene.failures
    assert torch.equal(loaded.views.registered, scene.views.registered)
    assert torch.equal(loaded.views.rotation[0], scene.views.rotation[0])
    assert torch.equal(loaded.views.center[0], scene.views.center[0])
    assert torch.equal(loaded.intrinsics.distortion, scene.intrinsics.distortion)
    assert (loaded.index_ratio, loaded.length_unit) == (1.333, "cm")
    assert loaded.interfaces.is_level


def test_covariances_of_centres_survive_the_file_to_the_last_bit(tmp_path, draw, scene):
    half = draw.normal(1, 3, 3)
    covariance = half @ half.mT
    known = Assessment(center_covariance=covariance)

    write_cameras(replace(scene, assessment=known), tmp_path / "cameras.json")
    found = read_cameras(tmp_path / "cameras.json").assessment

    assert torch.equal(found.center_covariance, covariance)
    assert float(found.center_sigma) == pytest.approx(float(covariance[0].trace() / 3.0) ** 0.5)


def test_without_covariances_nothing_is_known_of_the_centres(tmp_path, scene):
    write_cameras(scene, tmp_path / "cameras.json")

    found = read_cameras(tmp_path / "cameras.json").assessment

    assert (found.center_sigma, found.center_covariance) == (None, None)


def test_a_file_of_cameras_is_as_it_always_was(tmp_path, scene):
    """Whoever reads run folders relies on it, byte for byte."""
    pose = Rigid(torch.eye(3, dtype=torch.float64).repeat(2, 1, 1), torch.arange(6.0, dtype=torch.float64).view(2, 3))

    write_cameras(replace(scene, views=replace(scene.views, pose=pose)), tmp_path / "cameras.json")

    assert json.dumps(json.loads(CAMERAS_JSON), indent=1) + "\n" == (tmp_path / "cameras.json").read_text()


def test_several_cameras_of_any_model_come_back(tmp_path, scene):
    lenses = [
        Intrinsics.create(640, 480, 500.0, (310.0, 250.0), (0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6)),
        Intrinsics.create(480, 640, 300.0, distortion=(0.1, 0.2, 0.3, 0.4), model="fisheye"),
    ]
    cameras = replace(Cameras.of(lenses, ("phone", "gopro")), focal_sigma=torch.tensor([0.0, 0.02]).double())
    several = replace(scene, cameras=cameras, views=replace(scene.views, camera=torch.tensor([1, 0])))

    write_cameras(several, tmp_path / "cameras.json")
    found = read_cameras(tmp_path / "cameras.json")
    loaded = load_cameras(tmp_path)

    assert (found.cameras.names, found.cameras.models) == (("phone", "gopro"), ("opencv", "fisheye"))
    assert found.cameras.sizes == ((640, 480), (480, 640))
    for name in ("focal", "principal_point", "distortion", "focal_sigma", "principal_point_sigma"):
        assert torch.equal(getattr(found.cameras, name), getattr(cameras, name)), name
    assert found.views.camera.tolist() == [1, 0]
    assert loaded.intrinsics.focal[:, 0].tolist() == [cameras.focal[row, 0] for row in loaded_rows(several)]


def loaded_rows(scene):
    return scene.views.camera[scene.views.registered].tolist()


def test_cameras_of_a_run_have_names_and_project(tmp_path, draw, scene):
    write_cameras(scene, tmp_path / "cameras.json")
    points = draw.uniform(-1.0, 0.0, 10, 3)

    for place in (tmp_path, str(tmp_path / "cameras.json")):
        cameras = load_cameras(place)

        assert cameras.names == ("a.png",)
        assert cameras.shape == (1,)
        found, wanted = cameras.project(points), scene.camera_of(torch.tensor([0])).project(points)
        assert torch.equal(found[0], wanted[0])
        assert torch.equal(found[1], wanted[1])
    with pytest.raises(SceneError, match=r"nowhere.json is not a file"):
        load_cameras(tmp_path / "nowhere.json")


def test_an_unregistered_image_has_a_reason_and_no_pose(tmp_path, scene):
    write_cameras(scene, tmp_path / "cameras.json")
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
    known = _known(sigma, torch.tensor((0.5, 0.25, 1.0), dtype=torch.float64))

    write_points(points, colors, tmp_path / "points.ply", known)

    vertices = _raw_ply(tmp_path / "points.ply")["vertex"]
    assert list(vertices["properties"].items()) == [
        *((name, "<f4") for name in "xyz"),
        *((name, "<u1") for name in ("red", "green", "blue")),
        *((name, "<f4") for name in ("sigma", "sigma_x", "sigma_y", "sigma_z", "sigma_relative")),
    ]
    assert vertices["length"] == count
    if count:
        for name, part in (
            ("sigma", 1.0),
            ("sigma_x", 0.5),
            ("sigma_y", 0.25),
            ("sigma_z", 1.0),
            ("sigma_relative", 0.1),
        ):
            written = torch.from_numpy(vertices["data"][name].copy()).flatten()
            torch.testing.assert_close(written, (part * sigma).float(), rtol=1e-6, atol=0.0)
        assert torch.equal(torch.from_numpy(vertices["data"]["z"].copy()).flatten(), points[:, 2].float())
        loaded, loaded_colors = load_points(tmp_path / "points.ply")
        assert torch.allclose(loaded, points, rtol=1e-6)
        assert torch.equal(loaded_colors, colors)


def test_coordinates_of_a_map_keep_their_digits(tmp_path, draw):
    """Known to 3 cm at 4 123 456 m, or not known how well."""
    points = draw.uniform(-20.0, 20.0, 250, 3) + torch.tensor([512345.0, 4123456.0, 100.0], dtype=torch.float64)
    colors = torch.zeros(250, 3, dtype=torch.uint8)

    for sigma in (torch.full((250,), 0.03, dtype=torch.float64), None):
        write_points(points, colors, tmp_path / "points.ply", None if sigma is None else _known(sigma))

        assert torch.equal(load_points(tmp_path / "points.ply")[0], points)
        cloud = trimesh.load(tmp_path / "points.ply", process=False)
        assert cloud.vertices.tolist() == points.tolist()
        assert list(_raw_ply(tmp_path / "points.ply")["vertex"]["properties"].values())[:3] == ["<f8"] * 3


def test_coordinates_near_the_origin_are_floats(tmp_path, draw):
    points = draw.uniform(-20.0, 20.0, 250, 3)

    for sigma in (torch.full((250,), 0.03, dtype=torch.float64), None):
        known = None if sigma is None else _known(sigma)
        write_points(points, torch.zeros(250, 3, dtype=torch.uint8), tmp_path / "points.ply", known)

        assert list(_raw_ply(tmp_path / "points.ply")["vertex"]["properties"].values())[:3] == ["<f4"] * 3


def _known(sigma, along=(1.0, 1.0, 1.0)):
    """An assessment with these standard deviations along x, y and z, and a tenth of them relative to the cameras."""
    covariance = (sigma[:, None] * torch.as_tensor(along, dtype=torch.float64)).square().diag_embed()
    return Assessment(point_covariance=covariance, relative_covariance=0.01 * covariance)


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


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("cam_from_world_rotation", [[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "but must be a rotation"),
        ("cam_from_world_rotation", [[1.002, 0, 0], [0, 1, 0], [0, 0, 1]], "but must be a rotation"),
        ("cam_from_world_rotation", [[1e308, -1e308, 0], [0, 1, 0], [0, 0, 1]], "but must be a rotation"),
        ("center_in_world", [0, -1e13, 0], r"center_in_world\[1\] is -1e\+13, but must lie between -1e\+12 and 1e\+12"),
    ],
)
def test_poses_that_no_camera_has_are_refused(tmp_path, field, value, sentence):
    content = json.loads(CAMERAS_JSON)
    content["images"][0][field] = value
    for name in ("cameras.json", "truth.json"):
        (tmp_path / name).write_text(json.dumps(content | {"images": content["images"][:1]}))

    with pytest.raises(SceneError, match=sentence):
        read_cameras(tmp_path / "cameras.json")
    with pytest.raises(CaptureError, match=sentence):
        load_truth(tmp_path)


@pytest.mark.parametrize("angle", [0.0, 0.3, 3.1])
def test_rotations_with_the_digits_that_people_write_are_taken(tmp_path, angle):
    content = json.loads(CAMERAS_JSON)
    c, s = round(math.cos(angle), 4), round(math.sin(angle), 4)
    content["images"][0]["cam_from_world_rotation"] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    (tmp_path / "cameras.json").write_text(json.dumps(content))

    assert read_cameras(tmp_path / "cameras.json").views.rotation[0, 0, 0] == c


def _raw_ply(path):
    """The elements of a PLY file as they are in it, by name."""
    return trimesh.load(path, process=False).metadata["_ply_raw"]


def test_dry_points_are_marked_in_a_cloud(tmp_path, draw):
    dry = torch.tensor([True, False, True])
    colors = torch.zeros(3, 3, dtype=torch.uint8)
    write_points(draw.normal(3, 3), colors, tmp_path / "points.ply", _known(torch.ones(3).double()), dry)
    vertices, _ = read_vertices(tmp_path / "points.ply")
    assert vertices["dry"].tolist() == [1, 0, 1]
    write_points(draw.normal(3, 3), colors, tmp_path / "points.ply")
    assert "dry" not in (read_vertices(tmp_path / "points.ply")[0].dtype.names or ())
