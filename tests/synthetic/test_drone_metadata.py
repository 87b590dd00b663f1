"""A made flight goes through `torchrefrac import` and comes out as it truly was."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchrefrac import load_capture
from torchrefrac.camera import Intrinsics
from torchrefrac.commands.import_photographs import import_photographs
from torchrefrac.config.importing import ImportOptions
from torchrefrac.files.metadata.attitude import angles_of, cam_from_world
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import so3_exp, split_heading
from torchrefrac.recorder import SilentRecorder
from torchrefrac.synthetic.drone import CRS, ORIGIN, drone_tags
from torchrefrac.synthetic.library import render_scene
from torchrefrac.synthetic.options import DroneOptions, HeldCameraOptions, SensorOptions
from torchrefrac.synthetic.paths import look_at, ring
from torchrefrac.synthetic.stage import Stage, StageError

LENS = (-0.1, 0.02, 1e-3, -5e-4, 0.0)  # of the options in conftest.py


@pytest.fixture
def flight(floor, options, tmp_path):
    """`flight("drone")`: folder of a scene in m with six cameras around it, and that metadata."""

    def make(metadata, **others):
        center = ring(6, 15.0, (30.0, 42.0), (0.0, 360.0))
        rotation = look_at(center, 0.1 * center * center.new_tensor((1.0, 1.0, 0.0)), torch.linspace(-0.4, 0.4, 6))
        stage = Stage((floor,), rotation, center, "m", ambient=0.4, direct=0.6)
        chosen = replace(options, metadata=metadata, sensor=SensorOptions(samples=1), **others)
        return render_scene(stage, chosen, tmp_path / "cache", SilentRecorder())

    return make


def test_import_finds_what_the_drone_truly_did(flight, tmp_path):
    pytest.importorskip("pyproj")
    folder = flight("drone")
    options = ImportOptions(photos=str(folder / "images"), out=str(tmp_path / "river"), look=False)

    report = import_photographs(options, SilentRecorder())

    capture, truth = load_capture(tmp_path / "river"), load_truth(folder)
    assert capture.names == truth.names
    assert report["notes"] == []  # no gimbal of these went past straight down
    assert report["position"] == {"XMP drone-dji, RTK": 6}
    assert (capture.georeference.crs, capture.georeference.vertical) == (CRS, "ellipsoid")
    moved = torch.tensor(ORIGIN, dtype=torch.float64) - torch.tensor(capture.georeference.origin, dtype=torch.float64)
    sigma = torch.tensor((0.02, 0.02, 0.03), dtype=torch.float64)
    error = (capture.position - moved - truth.center) / sigma
    assert error.abs().max() < 4.0
    assert 0.5 < float(error.square().mean().sqrt()) < 1.5
    assert torch.allclose(capture.position_sigma, 1.5 * sigma.expand(6, 3))
    down, heading = split_heading(truth.rotation)
    angle = torch.linalg.cross(capture.down_in_cam, down).norm(dim=-1).rad2deg()
    assert 0.1 < float(angle.square().mean().div(2).sqrt()) < 0.6  # of 0.3 degrees about each axis
    turned = torch.remainder(capture.heading - heading + math.pi, 2.0 * math.pi) - math.pi
    assert turned.abs().max().rad2deg() < 1.5
    focal = 24.0 / math.tan(math.radians(30.0))
    assert capture.cameras.focal[0].tolist() == pytest.approx([focal] * 2)
    assert capture.cameras.distortion[0, :5].tolist() == pytest.approx(list(LENS))
    assert capture.cameras.principal_point[0].tolist() == [24.0, 18.0]


def test_over_a_river_that_falls_positions_and_verticals_are_level(floor, options):
    """By the definition: true gravity is `exp(tilt) (0, 0, -1)` in the frame of the water."""
    pytest.importorskip("pyproj")
    center = ring(6, 15.0, (30.0, 42.0), (0.0, 360.0))
    rotation = look_at(center, torch.zeros_like(center), torch.zeros(6))
    stage = Stage((floor,), rotation, center, "m", ambient=0.4, direct=0.6)
    exact = replace(options, metadata="drone", drone=DroneOptions(position_sigma=(1e-6, 1e-6), gimbal_sigma_deg=1e-6))
    lens = [Intrinsics.create(640, 480, 500.0)]

    flat, falling = (drone_tags(stage, lens, replace(exact, plane_tilt_deg=tilt)) for tilt in ((0.0, 0.0), (0.1, 0.4)))

    up = so3_exp(torch.tensor((0.1, 0.4, 0.0)).double().deg2rad())[:, 2]
    rise = [after.altitude - before.altitude for before, after in zip(flat, falling, strict=True)]
    assert rise == pytest.approx((center @ up - center[:, 2]).tolist(), abs=1e-4)
    assert max(rise) - min(rise) > 0.1
    angles = torch.tensor([(of.yaw, of.pitch, of.roll) for of in falling]).double().deg2rad()
    torch.testing.assert_close(cam_from_world(*angles.T)[:, :, 2], rotation @ up, rtol=0.0, atol=1e-6)


def test_cameras_that_take_photographs_in_turn_are_told_apart(flight, tmp_path):
    pytest.importorskip("pyproj")
    cameras = (
        HeldCameraOptions(width=48, height=36, fov_deg=60.0),
        HeldCameraOptions(width=36, height=48, fov_deg=50.0, quarter_turns=1),
    )
    folder = flight("drone", cameras=cameras)

    import_photographs(
        ImportOptions(photos=str(folder / "images"), out=str(tmp_path / "river"), look=False), SilentRecorder()
    )

    capture, truth = load_capture(tmp_path / "river"), load_truth(folder)
    assert capture.camera.tolist() == [0, 1] * 3
    assert capture.cameras.sizes == ((48, 36), (36, 48))
    assert capture.cameras.focal[:, 0].tolist() == pytest.approx([camera.focal for camera in cameras])
    down, heading = split_heading(truth.rotation)
    assert torch.linalg.cross(capture.down_in_cam, down).norm(dim=-1).rad2deg().max() < 1.5
    turned = torch.remainder(capture.heading - heading + math.pi, 2.0 * math.pi) - math.pi
    assert turned.abs().max().rad2deg() < 1.5


def test_metadata_changes_no_pixel_and_nothing_else_that_is_known(flight):
    pytest.importorskip("pyproj")
    plain, tagged = flight("none"), flight("drone")

    assert plain != tagged
    for path in sorted((plain / "images").iterdir()):
        other = tagged / "images" / path.name
        assert np.array_equal(cv2.imread(str(path)), cv2.imread(str(other)))
        assert b"drone-dji" in other.read_bytes()
    for name in ("capture.json", "truth.json"):
        assert json.loads((plain / name).read_text()) == json.loads((tagged / name).read_text())


def test_a_scene_without_metadata_has_the_folder_that_it_always_had(options):
    assert not {"metadata", "drone"} & set(options.fingerprint())
    assert "drone" in replace(options, metadata="drone").fingerprint()


def test_a_scene_in_centimetres_has_no_drone(stage, options):
    lens = Intrinsics.create(48, 36, 40.0)

    with pytest.raises(StageError, match="scene pond is measured in cm; metadata=drone needs a scene in m"):
        drone_tags(stage, [lens], replace(options, metadata="drone"))


def test_angles_of_a_gimbal_are_those_that_make_its_rotation(draw):
    yaw, roll = draw.uniform(-3.1, 3.1, 2, 50)
    pitch = draw.uniform(-1.5, 1.5, 50)

    found = angles_of(cam_from_world(yaw, pitch, roll))

    for angle, true in zip(found, (yaw, pitch, roll), strict=True):
        assert torch.allclose(angle, true, atol=1e-9)
