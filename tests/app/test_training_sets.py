"""Runs as training sets of other programs, and back."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest
import torch

import torchrefrac as tr
from torchrefrac.commands.export import export_run
from torchrefrac.commands.results import OutRefusedError
from torchrefrac.config.clouds import ExportOptions
from torchrefrac.files.colmap.model import read_colmap
from torchrefrac.files.tracks import read_scene
from torchrefrac.scene import CaptureError, SceneError

FORMS = ["nerfstudio", "gsplat"]


@pytest.fixture
def export(sparse, tmp_path):
    """`export(form, ...)`: the folder of a training set of the sparse run of three photographs."""

    def start(form, **options):
        export_run(ExportOptions(str(sparse / "run"), str(tmp_path / form), form, **options))
        return tmp_path / form

    return start


@pytest.mark.parametrize("form", FORMS)
def test_cameras_and_water_come_back_with_the_same_rays(sparse, export, draw, form):
    before = tr.load_cameras(sparse / "run")

    after = tr.load_cameras(export(form))

    assert after.names == before.names
    pixels = draw.uniform(0.0, 240.0, 3, 2)
    for one, other in zip(before.follow_rays(pixels), after.follow_rays(pixels), strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=1e-9)
    assert (after.intrinsics.width, after.intrinsics.height) == (320, 240)


@pytest.mark.parametrize("form", FORMS)
def test_photographs_lie_beside_the_cameras(sparse, export, form):
    folder = export(form)

    for name in tr.load_cameras(sparse / "run").names:
        assert (folder / "images" / name).read_bytes() == (sparse / "capture" / "images" / name).read_bytes()
    assert not (folder / "masks").exists()
    assert export(form) == folder  # again


def test_rays_by_the_rules_of_nerfstudio_are_those_of_a_pinhole(sparse, export):
    """A camera of nerfstudio looks along -z with y up, and counts pixels from the corner of the first."""
    content = json.loads((export("nerfstudio") / "transforms.json").read_text())
    cameras = tr.load_cameras(sparse / "run")

    assert content["camera_model"] == "OPENCV"
    assert [content[name] for name in ("w", "h")] == [320, 240]
    distortion = [content[name] for name in ("k1", "k2", "p1", "p2", "k3")]
    assert distortion == [0.0] * 5
    x, y = 100.5, 60.5
    for view, frame in enumerate(content["frames"]):
        assert frame["file_path"] == f"images/{cameras.names[view]}"
        pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        assert pose[3].tolist() == [0.0, 0.0, 0.0, 1.0]
        across = (x - content["cx"]) / content["fl_x"], -(y - content["cy"]) / content["fl_y"], -1.0
        ray = pose[:3, :3] @ torch.tensor(across, dtype=torch.float64)
        seen, valid = cameras[view].as_pinhole().project(pose[:3, 3] + 7.0 * ray)
        assert valid
        assert seen.tolist() == pytest.approx([x, y], abs=1e-9)


def test_points_and_models_are_complete(sparse, export):
    scene = read_scene(sparse / "run")

    splats = read_colmap(export("gsplat") / "sparse" / "0")

    assert len(splats.points) == len(scene.points)
    content = json.loads((export("nerfstudio") / "transforms.json").read_text())
    head = (export("nerfstudio") / content["ply_file_path"]).read_bytes()[:200].decode("latin1")
    assert f"element vertex {len(scene.points)}" in head
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(export("gsplat") / "sparse" / "0")
    assert sorted(image.name for image in model.images.values()) == sorted(scene.views.names)


def test_masks_of_all_photographs_are_named(sparse, export, tmp_path):
    capture = shutil.copytree(sparse / "capture", tmp_path / "capture")
    (capture / "masks").mkdir()
    for name in tr.load_cameras(sparse / "run").names:
        cv2.imwrite(str((capture / "masks" / name).with_suffix(".png")), np.full((240, 320), 255, np.uint8))

    folder = export("nerfstudio", capture=str(capture))

    for frame in json.loads((folder / "transforms.json").read_text())["frames"]:
        assert cv2.imread(str(folder / frame["mask_path"])).shape == (240, 320, 3)


def test_a_folder_of_photographs_is_not_taken_for_our_own(sparse, export, tmp_path):
    (tmp_path / "gsplat" / "images").mkdir(parents=True)

    with pytest.raises(OutRefusedError, match="holds images, which no export has written"):
        export("gsplat")
    assert os.listdir(tmp_path / "gsplat" / "images") == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model is 'EQUIRECTANGULAR', but must be 'OPENCV' or"),
        ({"frames": []}, "frames is empty, but must list at least one photograph"),
        ({"fl_x": 0.0}, "fl_x is 0, but must be above 0"),
    ],
)
def test_files_that_cannot_be_right_are_refused(export, change, problem):
    path = export("nerfstudio") / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))

    with pytest.raises((SceneError, CaptureError), match=problem):
        tr.load_cameras(path.parent)


def test_a_pose_that_is_no_rotation_is_refused(export):
    path = export("nerfstudio") / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"][1]["transform_matrix"][0][0] = 2.0
    path.write_text(json.dumps(content))

    with pytest.raises((SceneError, CaptureError), match=r"frames\[1\].transform_matrix is .* must be a rotation"):
        tr.load_cameras(path.parent)
