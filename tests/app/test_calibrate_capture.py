"""`torchrefrac calibrate capture=...`: a port, and two interfaces of one tank, from points whose places are known."""

import json

import pytest
import torch

import torchrefrac as tr
from torchrefrac import sfm
from torchrefrac.camera import Intrinsics
from torchrefrac.files.cameras import read_cameras
from torchrefrac.files.capture import load_capture
from torchrefrac.geometry import Rigid, so3_exp
from torchrefrac.scene import Interfaces, Observations, Scene
from torchrefrac.scene.interfaces import PORT, SURFACE, WALL

LENS = Intrinsics.create(1280, 960, 1000.0)
LAYERS = [{"index": 1.0}, {"index": 1.52, "thickness": 0.8}, {"index": 1.333}]


def _table(scene, noise, draw, path):
    """The CSV file of what the cameras of a scene see of its points."""
    m, n = len(scene.views), len(scene.points)
    point, view = (grid.flatten() for grid in torch.meshgrid(torch.arange(n), torch.arange(m), indexing="ij"))
    pixels, valid = scene.camera_of(view).project(scene.points[point], inside_image=True)
    pixels = pixels + noise * draw.normal(len(view), 2)
    lines = ["X,Y,Z,view,x,y"]
    for i in valid.nonzero()[:, 0].tolist():
        place = ",".join(f"{value:.10g}" for value in scene.points[point[i]].tolist())
        pixel = ",".join(f"{value:.6f}" for value in pixels[i].tolist())
        lines.append(f"{place},{scene.views.names[int(view[i])]},{pixel}")
    path.write_text("\n".join(lines))


def _capture(folder, names, stated, **image):
    camera = {"width": 1280, "height": 960, "fx": 1000.0, "fy": 1000.0, "cx": 640.0, "cy": 480.0}
    content = {
        "format": "torchrefrac-capture/2",
        "length_unit": "cm",
        "pixel_origin": "corner",
        "cameras": {"only": camera},
        "images": [{"name": name, **{key: of[name] for key, of in image.items()}} for name in names],
        **stated,
    }
    folder.mkdir()
    (folder / "capture.json").write_text(json.dumps(content))


def _grid(columns=8, rows=6, square=3.0, depth=0.0):
    x, y = torch.meshgrid(torch.arange(columns).double(), torch.arange(rows).double(), indexing="xy")
    flat = square * torch.stack((x, y), dim=-1).reshape(-1, 2) - square * torch.tensor((3.5, 2.5))
    return torch.cat((flat, torch.full((len(flat), 1), depth, dtype=torch.float64)), dim=-1)


@pytest.fixture
def dive(draw, tmp_path):
    """A capture of a housed camera before a board, whose port is stated 0.4 cm too far, and its table of points."""
    turns = so3_exp(0.45 * draw.uniform(-1.0, 1.0, 12, 3))
    facing = turns @ torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64))
    ahead = torch.cat((draw.uniform(-3.0, 3.0, 12, 2), draw.uniform(38.0, 55.0, 12, 1)), dim=-1)
    pose = Rigid(facing, -(facing.mT @ ahead[..., None])[..., 0])
    one = torch.ones(1, dtype=torch.float64)
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    port = Interfaces(down, -2.0 * one, 1.333 * one, 1.52 * one[:, None], 0.8 * one[:, None], (PORT,))
    names = [f"view{i}.png" for i in range(12)]
    truth = Scene.create(pose, LENS, port, _grid(), Observations.none(), names=names)
    stated = {"kind": "port", "layers": LAYERS, "normal_in_cam": [0.0, 0.02, -1.0], "distance": 2.4}
    _capture(tmp_path / "dive", names, {"interface": stated | {"distance_sigma": 0.5, "tilt_sigma_deg": 2.0}})
    _table(truth, 0.2, draw, tmp_path / "known.csv")
    return truth


def test_a_port_is_found_and_written_where_a_reconstruction_reads_it(torchrefrac, dive, metrics, tmp_path):
    ended = torchrefrac("calibrate", "capture=dive", "points=known.csv", "out=found")

    assert ended.status == 0, ended.err
    assert "known points in 12 images" in ended.out
    found = metrics(tmp_path / "found")
    (port,) = found["interfaces"]
    assert abs(-port["offset_cm"] - 2.0) < 3.0 * port["sigma"][2] < 1.0
    assert found["reprojection_rms_px"] == pytest.approx(0.2 * 2.0**0.5, rel=0.1)
    cameras = tr.load_cameras(tmp_path / "found")
    torch.testing.assert_close(cameras.center_in_world, dive.views.center, rtol=0.0, atol=0.3)
    written = load_capture(tmp_path / "found", with_images=False)
    assert written.interfaces.kinds == ("port",)
    assert float(written.interfaces.offset) == pytest.approx(port["offset_cm"])
    assert written.interfaces.sigmas["plane_height"] == pytest.approx(port["sigma"][2])
    assert (tmp_path / "found" / "residuals.csv").read_text().startswith("X,Y,Z,view,x,y,error_px,used")


def test_top_and_side_view_of_a_tank_meet_in_one_frame(torchrefrac, draw, metrics, tmp_path):
    """Two cameras through the surface, two through the glass, a board in the tank: points are right to 0.3 mm."""
    one = torch.ones(2, dtype=torch.float64)
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    thickness = torch.tensor([[0.0], [0.8]], dtype=torch.float64)
    tank = Interfaces(
        normals,
        torch.tensor([0.0, 20.0]).double(),
        1.333 * one,
        1.52 * one[:, None],
        thickness,
        (SURFACE, WALL),
    )
    above, aside = ([-12.0, 4.0, 45.0], [14.0, -3.0, 50.0]), ([-15.0, -70.0, -12.0], [12.0, -66.0, -20.0])
    center = torch.tensor((*above, *aside), dtype=torch.float64)
    middle = torch.tensor((0.0, 0.0, -15.0)).double()
    forward = torch.nn.functional.normalize(middle - center, dim=-1)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, torch.tensor([0.0, 0.3, 0.9]).double().expand_as(forward)), dim=-1
    )
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
    names = ["top0.png", "top1.png", "side0.png", "side1.png"]
    layers = torch.tensor((-8.0, -14.0, -20.0)).double()
    board = torch.cat([_grid(6, 5, 4.0, float(depth)) for depth in layers])
    pose, rows = Rigid(rotation, center), torch.tensor([0, 0, 1, 1])
    scene = Scene.create(pose, LENS, tank, board, Observations.none(), names=names, interface=rows)
    side = {"kind": "wall", "layers": LAYERS, "normal": [0.0, -1.0, 0.0], "offset": 20.0}
    top = {"kind": "surface", "index_ratio": 1.333, "normal": [0.0, 0.0, 1.0], "offset": 0.0}
    of = dict(zip(names, ["top", "top", "side", "side"], strict=True))
    _capture(tmp_path / "tank", names, {"interfaces": {"top": top, "side": side}}, interface=of)
    _table(scene, 0.3, draw, tmp_path / "known.csv")

    ended = torchrefrac("calibrate", "capture=tank", "points=known.csv", "out=found")

    assert ended.status == 0, ended.err
    found = read_cameras(tmp_path / "found" / "cameras.json")
    assert found.interfaces.kinds == ("surface", "wall")
    fish = torch.cat((draw.uniform(-10.0, 10.0, 300, 2), draw.uniform(-22.0, -6.0, 300, 1)), dim=-1)
    point = torch.arange(300).repeat_interleave(4)
    view = torch.arange(4).repeat(300)
    pixels, valid = scene.camera_of(view).project(fish[point])
    assert valid.all()
    seen = Observations(view, point, pixels + 0.3 * draw.normal(1200, 2))
    placed, outcome = sfm.triangulate(
        found.with_points(torch.zeros(300, 3).double(), torch.zeros(300, 3).to(torch.uint8), seen),
        sfm.Rules(),
        torch.ones(300, dtype=torch.bool),
    )
    assert outcome.done
    off = (placed.points - fish)[placed.placed]
    assert int(placed.placed.sum()) >= 295
    assert float(off.square().sum(dim=-1).mean().sqrt()) < 0.03


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda text: text.replace("Z,", "depth,", 1), "has no column Z"),
        (lambda text: text.replace("view3.png", "DSC3.png"), "view is 'DSC3.png', but must be one of view0.png"),
        (lambda text: text.replace("X,Y,Z,view,x,y\n", "X,Y,Z,view,x,y\n1,2,3,view0,4,abc\n"), "y is 'abc'"),
        (lambda text: "\n".join(text.splitlines()[:5]), "from which no pose was found"),
    ],
)
def test_points_that_cannot_be_used_are_refused_by_line_and_nothing_is_written(
    torchrefrac, dive, tmp_path, change, sentence
):
    path = tmp_path / "known.csv"
    path.write_text(change(path.read_text()))

    ended = torchrefrac("calibrate", "capture=dive", "points=known.csv", "out=found")

    assert ended.status == 1
    assert sentence in " ".join(ended.err.split())
    assert not (tmp_path / "found" / "cameras.json").exists()
