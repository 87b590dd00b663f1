"""Photographs through walls and ports of glass: against a tracer that follows rays one by one, and their files."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.synthetic.tracer import end_of, through_layers
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.config import OptionError, build
from torchrefrac.files.capture import load_capture
from torchrefrac.geometry import Plane
from torchrefrac.recorder import SilentRecorder
from torchrefrac.refraction import FlatInterface
from torchrefrac.synthetic.attitude import measure_attitude
from torchrefrac.synthetic.glass import glass_of
from torchrefrac.synthetic.library import render_scene
from torchrefrac.synthetic.options import (
    CameraOptions,
    HeldCameraOptions,
    InertialOptions,
    InterfaceOptions,
    SensorOptions,
)
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.scenes import (
    SCENES,
    AquariumOptions,
    HousingOptions,
    TableOptions,
    TankOptions,
    aquarium,
    cans,
    housing,
    riverbed,
    stage_of,
    table,
    tank,
)
from torchrefrac.synthetic.sight import see
from torchrefrac.synthetic.stage import StageError

PATTERNS = ("beans", "checkerboard", "coral", "grass", "gravel", "label", "rock", "scales", "tiles", "wood")
CALM = SensorOptions(samples=1, blur=0.0, noise=0.0)
DISTORTION = (-0.08, 0.02, 1e-3, -5e-4, 0.0)
PHONES = (
    HeldCameraOptions(width=64, height=48, fov_deg=60.0, distortion=DISTORTION),
    HeldCameraOptions(width=42, height=56, fov_deg=43.0, quarter_turns=1),
)
LENS_MIDDLE = torch.tensor(((32.0, 24.0),), dtype=torch.float64)
LENS = CameraOptions(width=64, height=48, fov_deg=75.0, distortion=DISTORTION)


def mottled(size, seed, **_):
    """Random colours, soon drawn."""
    return np.random.default_rng(seed).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def _draw_soon(patched):
    for module in (aquarium, cans, housing, table, tank):
        for name in PATTERNS:
            if hasattr(module, name):
                patched.setattr(module, name, mottled)
    patched.setattr(housing, "_colours", mottled)
    patched.setattr(riverbed, "colours", lambda size, *_: mottled(size, 0))


@pytest.fixture
def drawn_soon(monkeypatch):
    """Mottled surfaces, which take no time to draw."""
    _draw_soon(monkeypatch)


@pytest.fixture(scope="module")
def stages():
    """The aquarium and a small reef, with mottled surfaces, by their options."""
    with pytest.MonkeyPatch.context() as patched:
        _draw_soon(patched)
        options = (
            AquariumOptions(name="aquarium", cameras=PHONES, sensor=CALM),
            HousingOptions(name="housing", columns=2, rows=2, rocks=60, camera=LENS, sensor=CALM),
        )
        return {made.name: (made, stage_of(made)) for made in options}


def plane_of(pixels, camera):
    """Ideal image-plane coordinates by OpenCV, which counts pixels from the centre of the first."""
    focal = camera.focal
    matrix = np.array(((focal, 0.0, camera.width / 2 - 0.5), (0.0, focal, camera.height / 2 - 0.5), (0.0, 0.0, 1.0)))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-16)
    ideal = cv2.undistortPoints(pixels[:, None] - 0.5, matrix, np.array(camera.distortion), criteria=stop)
    return ideal[:, 0]


def face_of(options, rotation, center):
    """A point and the unit normal of the first face of glass, in the world."""
    if options.interface.kind == "wall":
        return np.zeros(3), np.array((0.0, 0.0, 1.0))
    turn = Rotation.from_rotvec((*options.interface.tilt_deg, 0.0), degrees=True)
    normal = rotation.T @ turn.apply((0.0, 0.0, -1.0))
    return center - options.interface.distance * normal, normal


def traced(options, stage, image, plane):
    """Where the ray of one place of an image ends, on which piece and at which texture coordinates."""
    surfaces = [piece.surface for piece in stage.pieces]
    rotation, center = stage.rotation[image].numpy(), stage.center[image].numpy()
    way = rotation.T @ np.array((*plane, 1.0))
    way /= np.linalg.norm(way)
    point, normal = face_of(options, rotation, center)
    layers = (1.0, options.interface.glass_index, options.index_ratio), (options.interface.glass_thickness,)
    wet, reach = through_layers(center, way, point, normal, *layers)
    if options.interface.kind == "wall":
        length, piece, uv = end_of(surfaces, center, way)
        if length < reach:
            return center + length * way, piece, uv
    assert wet is not None
    length, piece, uv = end_of(surfaces, *wet)
    return wet[0] + length * wet[1], piece, uv


@pytest.mark.parametrize(("name", "images", "rays"), [("aquarium", (0, 3, 6, 11), 22), ("housing", (0, 3), 12)])
def test_pixels_show_what_a_tracer_meets_that_follows_rays_one_by_one(stages, draw, name, images, rays):
    options, stage = stages[name]
    photographers = Photographer.each(replace(stage, ambient=1.0, direct=0.0), options)
    cameras = options.cameras or (options.camera,)
    pieces = set()
    for image in images:
        photographer, camera = photographers[image % len(photographers)], cameras[image % len(cameras)]
        size = torch.tensor((camera.width, camera.height))
        numbers = (draw.uniform(0.0, 1.0, rays, 2) * size).floor()
        pixels, photograph = numbers + 0.5, photographer.take(image)
        sight = photographer.look(image, pixels)
        for i, plane in enumerate(plane_of(pixels.numpy(), camera)):
            point, piece, uv = traced(options, photographer.stage, image, plane)
            assert int(sight.piece[i]) == piece
            np.testing.assert_allclose(sight.points[i].numpy(), point, rtol=0.0, atol=1e-9)
            pieces.add(stage.pieces[piece].name)
            if uv is None:
                continue
            np.testing.assert_allclose(sight.uv[i].numpy(), uv, rtol=0.0, atol=1e-9)
            colour = stage.pieces[piece].texture(torch.from_numpy(uv)[None])[0]
            column, row = numbers[i].long().tolist()
            assert torch.allclose(photograph[row, column], colour, atol=0.02)
    assert pieces >= ({"ground", "rocks"} if name == "housing" else {"gravel", "back", "stones", "cabinet_1"})


@pytest.mark.parametrize(("kind", "tilt_deg"), [("wall", (0.0, 0.0)), ("port", (0.0, 0.0)), ("port", (3.0, -2.0))])
def test_points_of_any_scene_project_back_through_its_glass(drawn_soon, draw, kind, tilt_deg):
    interface = InterfaceOptions(kind=kind, glass_thickness=2.0, distance=4.0, tilt_deg=tilt_deg)
    options = TankOptions(name="tank", interface=interface, camera=LENS)
    stage, glass = stage_of(options), glass_of(options)
    lens = Photographer.of(stage, options).intrinsics
    camera = RefractiveCamera(lens, stage.rotation[2], stage.center[2], glass)
    pixels = draw.uniform(0.0, 1.0, 500, 2) * torch.tensor((64.0, 48.0))

    sight = see(stage.pieces, camera, pixels)

    met = sight.piece >= 0
    back, valid = camera.project(sight.points[met])
    assert met.double().mean() > 0.9
    assert sight.in_water.all()
    assert valid.all()
    assert torch.allclose(back, pixels[met], atol=1e-8)


@pytest.mark.parametrize("kind", ["surface", "wall", "port"])
@pytest.mark.parametrize("name", ["tank", "cans", "table", "riverbed", "aquarium", "housing"])
def test_any_scene_is_photographed_through_any_interface(stages, drawn_soon, tmp_path, name, kind):
    if name in stages:
        own, stage = stages[name]
    else:
        more = {"columns": 2, "rows": 1, "obliques": 0, "boulders": 9} if name == "riverbed" else {"images": 4}
        own = build(SCENES[name], {"name": name, **more}, "scene")
        own = replace(own, camera=LENS, sensor=CALM)
        stage = stage_of(own)
    options = replace(own, interface=replace(own.interface, kind=kind))

    folder = render_scene(stage, options, tmp_path, SilentRecorder())

    said = json.loads((folder / "capture.json").read_text())
    assert said.get("interface", {"kind": "surface"})["kind"] == kind
    assert ("height" in said["images"][0]) == (kind != "port")
    with np.load(folder / "truth_points.npz") as seen:
        assert np.isfinite(seen["X"]).all(axis=-1).mean() > 0.6


def test_before_a_wall_gravity_lies_along_it_and_there_is_no_compass():
    options = AquariumOptions(
        name="a", plane_tilt_deg=(3.0, 0.0), inertial=InertialOptions(gravity_sigma_deg=0.0, heading_sigma_deg=2.0)
    )
    rotation = torch.eye(3, dtype=torch.float64)[None]

    attitude = measure_attitude(rotation, options)

    angle = math.radians(3.0)
    wanted = torch.tensor(((0.0, -math.cos(angle), -math.sin(angle)),), dtype=torch.float64)
    assert torch.allclose(attitude.true_down, wanted)
    assert torch.allclose(attitude.down_in_cam, wanted)
    assert attitude.heading is None


@pytest.fixture(scope="module")
def folders(stages, tmp_path_factory):
    """Of the two scenes: what capture.json and truth.json say, and the folder."""
    found = {}
    for name, (options, stage) in stages.items():
        folder = render_scene(stage, options, tmp_path_factory.mktemp(name), SilentRecorder())
        said = (json.loads((folder / file).read_text()) for file in ("capture.json", "truth.json"))
        found[name] = (*said, folder)
    return found


def test_the_aquarium_s_capture_states_the_wall_two_phones_and_gravity(folders, stages):
    capture, truth, _ = folders["aquarium"]

    assert capture["format"] == "torchrefrac-capture/2"
    assert "index_ratio" not in capture
    layers = [{"index": 1.0}, {"index": 1.52, "thickness": 1.2}, {"index": 1.333}]
    assert capture["interface"] == truth["interface"] == {"kind": "wall", "layers": layers}
    assert [capture["cameras"][name]["width"] for name in ("0", "1")] == [64, 42]
    assert [image["camera"] for image in capture["images"]] == 6 * ["0", "1"]
    assert ["height" in image for image in capture["images"]] == [True, *11 * [False]]
    assert capture["images"][0]["height"] == pytest.approx(52.0)
    assert capture["down_in_cam_sigma_deg"] == 0.5
    assert not any("heading_deg" in image for image in capture["images"])
    for image, true in zip(capture["images"], truth["images"], strict=True):
        down = np.array(true["cam_from_world_rotation"]) @ (0.0, -1.0, 0.0)
        assert down == pytest.approx(true["down_in_cam"])
        assert math.degrees(np.linalg.norm(np.cross(down, image["down_in_cam"]))) < 2.5


def test_the_housing_s_capture_states_the_port_and_neither_gravity_nor_heights(folders, stages):
    capture, truth, _ = folders["housing"]

    assert capture["format"] == "torchrefrac-capture/2"
    port = capture["interface"]
    assert port == truth["interface"]
    assert (port["kind"], port["distance"]) == ("port", 2.0)
    assert port["layers"] == [{"index": 1.0}, {"index": 1.52, "thickness": 0.8}, {"index": 1.333}]
    assert np.linalg.norm(port["normal_in_cam"]) == pytest.approx(1.0)
    assert math.degrees(math.acos(-port["normal_in_cam"][2])) == pytest.approx(1.0)
    assert list(capture["cameras"]) == ["0"]
    assert capture["images"] == [{"name": f"cam0{i}.png"} for i in range(4)]
    assert not any("sigma" in name for name in capture)


@pytest.mark.parametrize("name", ["aquarium", "housing"])
def test_true_points_project_to_their_pixels_through_the_glass_of_the_capture(folders, name):
    capture, truth, folder = folders[name]
    content = capture["interface"]
    port = content["kind"] == "port"
    glass = FlatInterface(
        layers=[layer["index"] for layer in content["layers"]],
        thickness=[layer["thickness"] for layer in content["layers"][1:-1]],
        plane=Plane(content["normal_in_cam"], -content["distance"]) if port else Plane(),
        moves_with_camera=port,
    )
    with np.load(folder / "truth_points.npz") as file:
        found = dict(file)
    image = 3
    lens, true = capture["cameras"][capture["images"][image].get("camera", "0")], truth["images"][image]
    intrinsics = Intrinsics.create(
        lens["width"], lens["height"], lens["fx"], (lens["cx"], lens["cy"]), lens["distortion"]
    )
    rotation, center = (torch.tensor(true[key]).double() for key in ("cam_from_world_rotation", "center_in_world"))
    points = torch.from_numpy(found["X"][image].astype(float))
    rows, columns = points.shape[:2]
    x, y = (float(found["offset"]) + 0.5 + int(found["step"]) * np.arange(count) for count in (columns, rows))
    wanted = torch.from_numpy(np.stack(np.meshgrid(x, y), axis=-1))
    known = points.isfinite().all(dim=-1)

    back, valid = RefractiveCamera(intrinsics, rotation, center, glass).project(points[known])

    assert known.double().mean() > 0.6
    assert valid.all()
    assert float((back - wanted[known]).norm(dim=-1).max()) < 1e-3


def views_of(stage, options, rows=16, columns=20):
    """What coarse grids of all images see: index of the piece (m, N), and points (m, N, 3)."""
    photographers = Photographer.each(stage, options)
    sights = []
    for image in range(len(stage.center)):
        photographer = photographers[image % len(photographers)]
        sights.append(photographer.look(image, photographer.intrinsics.pixel_grid(rows, columns).flatten(0, 1)))
    return torch.stack([sight.piece for sight in sights]), torch.stack([sight.points for sight in sights])


def test_the_photographs_of_the_aquarium_show_all_of_it_many_times_and_nothing_beyond(stages):
    _, stage = stages["aquarium"]

    piece, _ = views_of(stage, AquariumOptions(name="aquarium"))

    assert (piece >= 0).all()
    images = {one.name: int((piece == i).any(dim=-1).sum()) for i, one in enumerate(stage.pieces)}
    for name in ("gravel", "back", "stones", "arch", "fish", "column", "can", "tube"):
        assert images[name] >= 8, name
    dry = torch.stack([piece == i for i, one in enumerate(stage.pieces) if one.name.startswith("cabinet")]).any(dim=0)
    assert 0.02 < dry.double().mean() < 0.25


def test_what_is_not_at_its_margin_several_photographs_of_the_reef_show(drawn_soon):
    options = HousingOptions(name="housing")
    stage = stage_of(options)

    piece, points = views_of(stage, options)

    assert (piece >= 0).all()
    cell = (points[..., :2] / 25.0).floor().long()
    inside = (points[..., 0].abs() < 180.0) & (points[..., 1].abs() < 120.0)
    cells = [set(map(tuple, own[there].tolist())) for own, there in zip(cell, inside, strict=True)]
    counts = [sum(place in own for own in cells) for place in set.union(*cells)]
    assert np.median(counts) >= 6
    assert np.mean(np.array(counts) >= 3) > 0.9
    low = (
        stage.center[:, 2] - torch.tensor([float(one.surface.triangles()[0][:, 2].max()) for one in stage.pieces]).max()
    )
    assert float(low.min()) > 30.0


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (
            "tank",
            {"interface": {"kind": "window"}},
            "scene.interface.kind is 'window', but must be one of ",
        ),
        (
            "tank",
            {"interface": {"glass_index": 0.9}},
            "scene.interface.glass_index is 0.9, but must lie",
        ),
        ("tank", {"interface": {"glass_thickness": -1.0}}, "scene.interface.glass_thickness is -1"),
        ("tank", {"interface": {"distance": 0.0}}, "scene.interface.distance is 0"),
        (
            "tank",
            {"interface": {"tilt_deg": [1.0]}},
            r"scene.interface.tilt_deg is \[1.0\], but must be two",
        ),
        ("tank", {"interface": {"tilt_deg": [0.0, 40.0]}}, "two angles up to 30 degrees"),
        (
            "aquarium",
            {"waves": {"rms_slope": 0.1}},
            "scene.waves.rms_slope is 0.1, but must be 0: interface.kind",
        ),
        ("housing", {"reflection": 90.0}, "scene.reflection is 90, but must be 0: interface.kind is port"),
        ("housing", {"metadata": "drone"}, "scene.metadata is drone, but must be none: interface.kind is port"),
        ("aquarium", {"distances": []}, "scene.distances is empty"),
        ("aquarium", {"distances": [0.1]}, "scene.distances is 0.1, but must be finite and above 0.4"),
        ("aquarium", {"images": 1}, "scene.images is 1"),
        ("housing", {"columns": 1, "rows": 1}, "two photographs or more"),
        ("housing", {"overlap": 1.0}, "scene.overlap is 1"),
        ("housing", {"altitudes": []}, "scene.altitudes is empty"),
        ("housing", {"altitudes": [20.0]}, "scene.altitudes is 20"),
        ("housing", {"rocks": -1}, "scene.rocks is -1"),
    ],
)
def test_options_of_glass_that_make_no_sense_are_refused_by_name(kind, values, message):
    with pytest.raises(OptionError, match=message):
        build(SCENES[kind], {"name": kind, **values}, "scene")


def test_a_camera_behind_the_wall_is_refused(stages, tmp_path):
    options, stage = stages["aquarium"]
    behind = replace(stage, center=stage.center - torch.tensor((0.0, 0.0, 70.0)))

    with pytest.raises(StageError, match=r"cam00.png stands at z = -18 cm, but must stand before the glass, z = 0"):
        render_scene(behind, options, tmp_path, SilentRecorder())


def test_the_water_behind_glass_has_no_extent_and_that_of_a_surface_keeps_it(drawn_soon):
    options = TableOptions(name="table", camera=LENS)
    port = replace(options, interface=InterfaceOptions(kind="port"))
    stage = stage_of(options)

    open_water, behind = Photographer.of(stage, options), Photographer.of(stage, port)

    assert open_water.stage.water_extent == stage.water_extent
    assert behind.stage.water_extent == ()
    assert behind.look(0, LENS_MIDDLE).in_water.all()


def test_without_gravity_a_capture_over_water_has_the_second_format(drawn_soon, tmp_path):
    inertial = InertialOptions(gravity_sigma_deg=None, heading_sigma_deg=None)
    options = TankOptions(name="tank", images=2, camera=LENS, sensor=CALM, inertial=inertial)

    capture = load_capture(render_scene(stage_of(options), options, tmp_path, SilentRecorder()))

    assert not capture.has_gravity
    assert capture.index_ratio == 1.333
    assert capture.has_height.tolist() == [True, False]
