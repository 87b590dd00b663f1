"""The scenes that can be made: where things stand, what cameras see of them, and what is refused."""

import json
import math
from pathlib import Path

import cv2
import hydra
import numpy as np
import pytest
import torch
import trimesh
from omegaconf import OmegaConf

import torchrefrac
from torchrefrac import FlatInterface, RefractiveCamera
from torchrefrac.camera import Intrinsics
from torchrefrac.config import OptionError, build, build_scene
from torchrefrac.geometry import split_heading
from torchrefrac.geometry.surfaces import nearest
from torchrefrac.synthetic.options import CameraOptions, SyntheticOptions
from torchrefrac.synthetic.paths import grid, look_at, ring, rolls
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.scenes import (
    SCENES,
    CansOptions,
    MeshOptions,
    RiverbedOptions,
    TableOptions,
    TankOptions,
    cans,
    ground,
    mesh,
    mesh_colours,
    riverbed,
    stage_of,
    table,
    tank,
)
from torchrefrac.synthetic.stage import StageError

CONF = Path(torchrefrac.__file__).parents[1] / "conf"
NARROW = CameraOptions(width=160, height=120, fov_deg=20.0)


@pytest.fixture
def plain(monkeypatch):
    """Grey instead of all that is drawn: where only the geometry matters."""

    def grey(size, seed, **_):
        return np.full((8, 8, 3), seed % 200, dtype=np.uint8)

    for module in (tank, table, cans, ground, mesh, mesh_colours):
        for name in ("gravel", "beans", "grass", "sand", "label", "checkerboard", "tiles", "wood"):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, grey)
    monkeypatch.setattr(riverbed, "colours", lambda size, *_: np.zeros((8, 8, 3), dtype=np.uint8))


def seen(stage, options, columns=16, rows=12):
    """Of a coarse grid of pixels (m, N) what they see: index of the piece, -1 for none; pieces above the water too."""
    lens = Intrinsics.create(options.camera.width, options.camera.height, options.camera.focal)
    surfaces = [piece.surface for piece in stage.pieces]
    found = []
    for rotation, center in zip(stage.rotation, stage.center, strict=True):
        camera = RefractiveCamera(lens, rotation, center, FlatInterface(options.index_ratio))
        origins, before, after, _ = camera.follow_rays(lens.pixel_grid(rows, columns).reshape(-1, 2))
        dry = nearest(surfaces, center.expand_as(before).contiguous(), before)
        wet = nearest(surfaces, origins.contiguous(), after)
        found.append(torch.where(dry.length < (origins - center).norm(dim=-1), dry.surface, wet.surface))
    return torch.stack(found)


def shares(stage, options):
    """Of the pixels of all images together, by the name of a piece."""
    index = seen(stage, options)
    return {piece.name: float((index == i).double().mean()) for i, piece in enumerate(stage.pieces)}


def test_a_camera_sees_its_target_in_the_middle_and_up_above(draw):
    center = draw.uniform(-3.0, 3.0, 50, 3) + torch.tensor((0.0, 0.0, 9.0), dtype=torch.float64)
    target = draw.uniform(-3.0, 3.0, 50, 3)

    rotation = look_at(center, target)

    ahead = torch.nn.functional.normalize(torch.einsum("nij,nj->ni", rotation, target - center), dim=-1)
    assert torch.allclose(ahead, torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64).expand_as(ahead), atol=1e-12)
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand_as(rotation), atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(50, dtype=torch.float64))
    assert float(rotation[:, 0, 2].abs().max()) < 1e-12
    assert float(rotation[:, 1, 2].max()) < 0.0


def test_a_camera_that_looks_straight_down_has_north_on_top():
    center = torch.tensor((1.0, 2.0, 5.0), dtype=torch.float64)

    rotation = look_at(center, center - torch.tensor((0.0, 0.0, 4.0), dtype=torch.float64))

    assert torch.allclose(rotation, torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64)))


def test_a_roll_turns_x_towards_y_and_leaves_the_axis():
    center, target = torch.tensor([[4.0, 1.0, 3.0]], dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)

    straight, rolled = look_at(center, target)[0], look_at(center, target, math.radians(30.0))[0]

    c, s = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
    assert torch.allclose(rolled[0], c * straight[0] + s * straight[1])
    assert torch.allclose(rolled[2], straight[2])


def test_a_camera_at_its_target_is_refused():
    with pytest.raises(ValueError, match="must lie apart"):
        look_at(torch.zeros(3), torch.zeros(3))


def test_a_closed_ring_divides_the_circle_and_an_open_one_has_both_its_ends():
    closed, opened = ring(4, 2.0, [1.0, 3.0], (0.0, 360.0)), ring(3, (2.0, 1.0), [5.0], (0.0, 180.0))

    expected = [[2, 0, 1], [0, 2, 3], [-2, 0, 1], [0, -2, 3]]
    assert torch.allclose(closed, torch.tensor(expected, dtype=torch.float64), atol=1e-12)
    assert torch.allclose(opened, torch.tensor([[2, 0, 5], [0, 1, 5], [-2, 0, 5]], dtype=torch.float64), atol=1e-12)


def test_a_grid_is_flown_to_and_fro():
    flown = grid(3, 2, (2.0, 4.0), 7.0)

    expected = [[-2, -2, 7], [0, -2, 7], [2, -2, 7], [2, 2, 7], [0, 2, 7], [-2, 2, 7]]
    assert flown.tolist() == expected


def test_rolls_vary_within_their_bound():
    angle = rolls(30, 4.0)

    assert float(angle.abs().max()) <= math.radians(4.0)
    assert float(angle.std()) > math.radians(2.0)


@pytest.mark.usefixtures("plain")
def test_the_tank_is_that_of_the_shared_truth(shared_data):
    truth = json.loads((shared_data("tank") / "truth.json").read_text())

    stage = stage_of(TankOptions(name="tank"))

    centers = torch.tensor([image["center_in_world"] for image in truth["images"]], dtype=torch.float64)
    rotations = torch.tensor([image["cam_from_world_rotation"] for image in truth["images"]], dtype=torch.float64)
    assert torch.allclose(stage.center, centers, atol=1e-9)
    assert torch.allclose(stage.rotation[:, 2], rotations[:, 2], atol=1e-9)
    for piece, plane in zip(stage.pieces, truth["planes"], strict=True):
        assert piece.name == plane["name"]
        assert piece.is_plane
        for edge, name in (("corner", "origin"), ("edge1", "e1"), ("edge2", "e2")):
            expected = torch.tensor(plane[name], dtype=torch.float64)
            assert torch.allclose(getattr(piece.surface, edge), expected, atol=1e-9)


@pytest.mark.usefixtures("plain")
def test_the_planes_of_the_tank_keep_their_height_above_its_bottom():
    stage = stage_of(TankOptions(name="tank", depth=60.0, images=5))

    lowest = [float(piece.surface.triangles()[0][:, 2].min()) for piece in stage.pieces]
    assert lowest == pytest.approx([-60.0, -52.0, -52.0])
    assert len(stage.center) == 5


@pytest.mark.usefixtures("plain")
def test_the_tank_fills_its_photographs():
    options = TankOptions(name="tank")

    found = shares(stage_of(options), options)

    assert sum(found.values()) > 0.97
    assert min(found.values()) > 0.15


@pytest.mark.usefixtures("plain")
def test_the_photographs_of_the_cans_show_little_of_the_bench_and_nothing_beyond():
    options = CansOptions(name="cans", camera=CameraOptions(fov_deg=60.0))

    found = shares(stage_of(options), options)

    assert sum(found.values()) > 0.99
    assert sum(share for name, share in found.items() if name.startswith("bench")) < 0.12
    assert found["bottom"] > 0.25
    assert min(found[name] for name in ("coffee_top", "tea", "tube")) > 0.02


@pytest.mark.usefixtures("plain")
def test_of_the_cans_the_packets_stand_on_the_bottom_and_the_tube_leans_on_one():
    pieces = {piece.name: piece for piece in stage_of(CansOptions(name="cans", depth=20.0)).pieces}

    tube, top = pieces["tube"].surface, pieces["coffee_top"].surface
    assert float(tube.triangles()[0][:, 2].min()) == pytest.approx(-20.0, abs=1e-3)
    assert float(pieces["tea"].surface.triangles()[0][:, 2].min()) == pytest.approx(-20.0)
    edge = top.corner + top.edge1 + 0.5 * top.edge2
    along = tube.axis / tube.axis.norm()
    off = edge - tube.base - ((edge - tube.base) @ along) * along
    assert float(off.norm()) == pytest.approx(tube.radius)
    assert top.triangles()[0][:, 2].tolist() == pytest.approx(4 * [-8.0])


def test_the_walls_of_the_cans_reach_above_the_water_for_any_depth():
    with pytest.raises(ValueError, match="rim"):
        CansOptions(name="cans", heights=(6.0,))


@pytest.mark.usefixtures("plain")
def test_a_riverbed_is_as_deep_as_asked_and_has_a_dry_bank():
    options = RiverbedOptions(name="riverbed", depth=2.2, camera=NARROW)

    vertices = stage_of(options).pieces[0].surface.triangles()[0]

    assert float(vertices[:, 2].min()) == pytest.approx(-2.2)
    assert float(vertices[:, 2].max()) > 0.3
    assert 0.02 < float((vertices[:, 2] > 0.0).double().mean()) < 0.4


@pytest.mark.usefixtures("plain")
def test_a_drone_looks_down_with_one_heading_and_sees_only_ground():
    options = RiverbedOptions(name="riverbed", columns=3, rows=2, obliques=4, camera=NARROW, position_sigma=None)

    stage = stage_of(options)

    down, heading = split_heading(stage.rotation)
    assert len(stage.center) == 10
    assert torch.allclose(stage.center[:, 2], torch.full((10,), 25.0, dtype=torch.float64))
    assert float(down[:6, 2].min()) > math.cos(math.radians(3.0))
    assert float(down[6:, 2].max()) == pytest.approx(math.cos(math.radians(30.0)))
    assert float(heading[:6].abs().max()) < math.radians(4.0)
    assert stage.position_sigma is None
    assert float((seen(stage, options)[:6] >= 0).double().mean()) == 1.0


def test_the_colours_of_a_riverbed_differ_on_the_bank_and_do_not_depend_on_the_run():
    options = RiverbedOptions(name="riverbed", columns=2, rows=2, obliques=0, boulders=20, camera=NARROW, seed=3)

    stage, again = stage_of(options), stage_of(options)

    uv = torch.rand(4000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    colours = stage.pieces[0].texture(uv)
    assert torch.equal(colours, again.pieces[0].texture(uv))
    north, south = colours[uv[:, 1] > 0.93].mean(dim=0), colours[uv[:, 1] < 0.5].mean(dim=0)
    assert float(north[1] - north[0]) > 10.0
    assert float(south[1] - south[0]) < 5.0


@pytest.fixture
def ball(tmp_path):
    """Writes a sphere of radius 1 about (5, 6, 7) to a file of the given name; returns its path."""

    def write(name="ball.ply", change=None):
        sphere = trimesh.creation.icosphere(subdivisions=2)
        sphere.apply_translation((5.0, 6.0, 7.0))
        if change is not None:
            change(sphere)
        sphere.export(tmp_path / name)
        return str(tmp_path / name)

    return write


@pytest.mark.usefixtures("plain")
def test_a_mesh_is_scaled_and_lies_as_deep_as_asked_above_the_origin(ball):
    options = MeshOptions(name="mesh", file=ball(), scale=2.0, depth=6.0)

    vertices = stage_of(options).pieces[0].surface.triangles()[0]

    assert torch.allclose(vertices.amin(dim=0), torch.tensor((-2.0, -2.0, -6.0), dtype=torch.float64), atol=1e-5)
    assert torch.allclose(vertices.amax(dim=0), torch.tensor((2.0, 2.0, -2.0), dtype=torch.float64), atol=1e-5)


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("heights", [None, (4.0, 7.0)])
def test_every_image_sees_all_of_a_mesh_and_ground_around_it(ball, heights):
    options = MeshOptions(name="mesh", file=ball(), heights=heights, camera=CameraOptions(fov_deg=50.0), images=6)

    stage = stage_of(options)

    index = seen(stage, options, 40, 30).reshape(-1, 30, 40)
    border = torch.cat((index[:, 0], index[:, -1], index[:, :, 0], index[:, :, -1]), dim=-1)
    assert not bool((border == 0).any())
    assert float((index == 0).double().mean()) > 0.08
    assert float((index >= 0).double().mean()) > 0.97
    assert float(stage.center[:, 2].min()) > 0.0


@pytest.mark.usefixtures("plain")
def test_a_mesh_whose_y_points_upwards_is_turned(tmp_path):
    trimesh.creation.box((1.0, 3.0, 2.0)).export(tmp_path / "box.obj")

    stage = stage_of(MeshOptions(name="mesh", file=str(tmp_path / "box.obj"), up="y", ground=False))

    vertices = stage.pieces[0].surface.triangles()[0]
    extent = (vertices.amax(dim=0) - vertices.amin(dim=0)).tolist()
    assert extent == pytest.approx([1.0, 2.0, 3.0])
    assert len(stage.pieces) == 1


def colours_from_above(stage, points):
    """Colours where vertical rays above points (N, 2) meet the first piece."""
    origins = torch.cat((points, torch.full_like(points[:, :1], 50.0)), dim=-1)
    down = torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64).expand_as(origins).contiguous()
    met = stage.pieces[0].surface.intersect(origins, down)
    return stage.pieces[0].texture(met.uv), origins + met.length[:, None] * down


@pytest.mark.usefixtures("plain")
def test_a_mesh_has_the_colours_of_its_vertices(ball, draw):
    def paint(sphere):
        sphere.visual.vertex_colors = np.clip(127.5 * (sphere.vertices - (5, 6, 7) + 1.0), 0, 255).astype(np.uint8)

    stage = stage_of(MeshOptions(name="mesh", file=ball(change=paint)))

    colours, places = colours_from_above(stage, draw.uniform(-0.6, 0.6, 60, 2))
    middle = stage.pieces[0].surface.triangles()[0]
    inside = places - 0.5 * (middle.amin(dim=0) + middle.amax(dim=0))
    assert torch.allclose(colours.double(), 127.5 * (inside + 1.0), atol=1.5)


@pytest.mark.usefixtures("plain")
def test_a_mesh_has_the_colours_of_its_faces(tmp_path):
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    box.visual.face_colors = np.where(box.face_normals[:, 2:] > 0.5, (200, 30, 40, 255), (0, 0, 0, 255)).astype(
        np.uint8
    )
    box.export(tmp_path / "box.ply")

    stage = stage_of(MeshOptions(name="mesh", file=str(tmp_path / "box.ply")))

    colours, _ = colours_from_above(stage, torch.tensor([[0.3, 0.4], [-0.6, 0.1]], dtype=torch.float64))
    assert colours.round().tolist() == [[200, 30, 40], [200, 30, 40]]


@pytest.mark.usefixtures("plain")
def test_a_mesh_has_the_colours_of_its_image(tmp_path, draw):
    picture = np.zeros((64, 64, 3), dtype=np.uint8)
    picture[:, :32], picture[:32, 32:] = (0, 0, 250), (0, 240, 0)
    cv2.imwrite(str(tmp_path / "picture.png"), picture)
    (tmp_path / "board.mtl").write_text("newmtl board\nmap_Kd picture.png\n")
    (tmp_path / "board.obj").write_text(
        "mtllib board.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "usemtl board\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )

    stage = stage_of(MeshOptions(name="mesh", file=str(tmp_path / "board.obj")))

    colours, _ = colours_from_above(stage, torch.tensor([[-0.3, 0.2], [0.3, 0.2], [0.3, -0.2]], dtype=torch.float64))
    assert colours.round().tolist() == [[250, 0, 0], [0, 240, 0], [0, 0, 0]]


def test_a_mesh_without_colours_is_of_stone(ball, draw):
    stage = stage_of(MeshOptions(name="mesh", file=ball("ball.stl"), ground=False))

    colours, _ = colours_from_above(stage, draw.uniform(-0.6, 0.6, 400, 2))
    assert float(colours.std()) > 25.0


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.ply", None, "there is no such file"),
        ("broken.ply", b"garbage", r"broken\.ply cannot be read as a mesh: "),
        ("broken.glb", b"garbage", r"broken\.glb cannot be read as a mesh: "),
        ("far.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n", r"far\.obj cannot be read as a mesh: "),
        ("what.xyzq", b"1 2 3", r"what\.xyzq cannot be read as a mesh: "),
        ("points.obj", b"v 0 0 0\nv 1 0 0\n", "holds no triangles"),
        ("flawed.off", b"OFF\n3 1 0\n0 0 nan\n1 0 0\n0 1 0\n3 0 1 2\n", "not finite"),
        ("dot.off", b"OFF\n3 1 0\n1 1 1\n1 1 1\n1 1 1\n3 0 1 2\n", "extent of 0"),
    ],
)
def test_a_file_that_is_no_mesh_is_refused_by_name(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)

    with pytest.raises(StageError, match=message):
        stage_of(MeshOptions(name="mesh", file=str(tmp_path / name)))


@pytest.mark.usefixtures("plain")
def test_a_mesh_that_reaches_out_of_the_water_is_refused_with_the_remedy_unless_that_is_meant(ball):
    file = ball()

    with pytest.raises(StageError, match=r"reaches 1\.5 m above the water: a scene\.depth of more than 2 or a scene"):
        stage_of(MeshOptions(name="mesh", file=file, depth=0.5))

    dry = stage_of(MeshOptions(name="mesh", file=file, depth=0.5, allow_dry=True))
    assert float(dry.pieces[0].surface.triangles()[0][:, 2].max()) == pytest.approx(1.5, abs=1e-5)
    assert float(dry.center[:, 2].min()) > 1.5


def test_the_fingerprint_of_a_mesh_is_that_of_its_file(ball):
    options = MeshOptions(name="mesh", file=ball())

    first, again = options.fingerprint(), options.fingerprint()
    ball(change=lambda sphere: sphere.apply_scale(1.1))
    other = options.fingerprint()

    assert first == again
    assert first != other
    assert {key: first[key] for key in first if key != "content"} == {
        key: other[key] for key in first if key != "content"
    }


def test_fingerprints_tell_kinds_of_scenes_apart():
    assert TankOptions(name="x").fingerprint()["scene"] == "TankOptions"
    with pytest.raises(StageError, match="cannot be read: No such file"):
        MeshOptions(name="mesh", file="nowhere.ply").fingerprint()


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        ("tank", {"depth": 45.0}, "scene.depth is 45, but must be finite and above 45.5"),
        ("tank", {"images": 1}, "scene.images is 1, but must lie between 2 and 500"),
        ("tank", {"radius": 0.0}, "scene.radius is 0"),
        ("tank", {"heights": []}, "scene.heights is empty"),
        ("tank", {"heights": [3.0, -1.0]}, "scene.heights is -1"),
        ("tank", {"index_ratio": 0.5}, "scene.index_ratio is 0.5"),
        ("cans", {"depth": 10.0}, "scene.depth is 10, but must be finite and at least 16"),
        ("riverbed", {"depth": 0.0}, "scene.depth is 0"),
        ("riverbed", {"depth": 30.0}, "must be at most the drone's altitude of 25"),
        ("riverbed", {"columns": 0}, "scene.columns is 0"),
        ("riverbed", {"columns": 1, "rows": 1}, "two photographs or more"),
        ("riverbed", {"overlap": 1.0}, "scene.overlap is 1"),
        ("riverbed", {"obliques": -1}, "scene.obliques is -1"),
        ("riverbed", {"position_sigma": 0.0}, "scene.position_sigma is 0"),
        ("mesh", {"file": ""}, "scene.file is empty"),
        ("mesh", {"file": "x", "scale": 0.0}, "scene.scale is 0"),
        ("mesh", {"file": "x", "depth": -1.0}, "scene.depth is -1"),
        ("mesh", {"file": "x", "up": "x"}, "scene.up is 'x', but must be one of y, z"),
        ("mesh", {"file": "x", "length_unit": ""}, "scene.length_unit is empty"),
        ("mesh", {}, "scene.file is missing"),
    ],
)
def test_options_of_a_scene_that_make_no_sense_are_refused_by_name(kind, values, message):
    with pytest.raises(OptionError, match=message):
        build(SCENES[kind], {"name": kind, **values}, "scene")


def test_options_of_no_scene_are_refused():
    with pytest.raises(TypeError, match="SyntheticOptions, but must be of one of tank, cans, riverbed, mesh"):
        stage_of(SyntheticOptions(name="x"))


def composed(*overrides):
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return OmegaConf.to_container(hydra.compose("config", overrides=list(overrides)).scene, resolve=True)


@pytest.mark.parametrize(
    ("name", "fov"),
    [
        ("tank", 75.0),
        ("cans", 60.0),
        ("riverbed", 65.0),
        ("mesh", 50.0),
        ("aquarium", 75.0),
        ("housing", 75.0),
    ],
)
def test_the_yaml_of_a_scene_says_what_its_dataclass_says(name, fov):
    extra = ("scene.file=x.ply",) if name == "mesh" else ()

    values = composed(f"scene={name}", *extra)
    options = build_scene(values)

    required = {"name": name, **({"file": "x.ply"} if name == "mesh" else {})}
    own = SCENES[name](**required)
    assert type(options) is SCENES[name]
    assert options.camera == CameraOptions(fov_deg=fov)
    for field in set(values) - {"kind", "camera", "waves"}:
        assert getattr(options, field) == getattr(own, field), field
    assert set(values) == {"kind", *own.__dataclass_fields__}


def test_shared_and_own_options_of_a_scene_are_overridden_on_the_command_line():
    options = build_scene(composed("scene=tank", "scene.index_ratio=1.2", "scene.camera.width=640", "scene.depth=80"))

    assert isinstance(options, TankOptions)
    assert (options.index_ratio, options.camera.width, options.depth) == (1.2, 640, 80.0)


def test_the_photographs_of_the_table_show_as_much_beside_the_water_as_in_it(plain):
    options = TableOptions(name="table", camera=CameraOptions(width=160, height=120))
    stage = stage_of(options)
    photographer = Photographer.of(stage, options)
    for image in range(len(stage.center)):
        sight = photographer.look(image, photographer.intrinsics.pixel_grid(12, 16).flatten(0, 1))
        below = sight.points[:, 2] < -1.0
        outside = below & ~sight.in_water
        assert 0.15 < outside.double().mean() < 0.75
        assert 0.2 < (below & sight.in_water).double().mean() < 0.75
        inside = (sight.points[:, 0].abs() <= 35.01) & (sight.points[:, 1].abs() <= 27.01)
        assert not (outside & inside).any()
        assert inside[below & sight.in_water].all()
