"""Photographs and models as people hand them in, that once went wrong in silence; each against its truth.

The photographs are five of the embedded scene, whose 800 strongest keypoints give their cameras to 0.1 cm.
"""

import json

import cv2
import numpy as np
import pytest
import torch

import torchrefrac as tr
from torchrefrac.commands.adjust import adjust_run
from torchrefrac.config import AdjustOptions, PlaneOptions
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.features import SiftOptions
from torchrefrac.files.cameras import load_points
from torchrefrac.files.colmap.model import read_colmap
from torchrefrac.recorder import SilentRecorder

VIEWS = range(5)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "case",
    [
        "01-mask-ignored-by-sparse",
        pytest.param("06-12bit-in-16bit", marks=SLOW),
        pytest.param("08-alpha", marks=SLOW),
    ],
)
def test_photographs_that_are_masked_transparent_or_of_twelve_bits_are_reconstructed(shared_case, case):
    folder = shared_case(case)

    _require_right(tr.load_capture(folder), tr.load_truth(folder))


def test_photographs_of_hardly_any_contrast_are_reconstructed(part_of_tank, draw):
    """15 % of it, a blur of 0.8 pixels, and noise of a grey level."""
    folder = part_of_tank(VIEWS)
    for path in sorted((folder / "images").iterdir()):
        picture = cv2.GaussianBlur(cv2.imread(str(path)).astype(np.float64), (0, 0), 0.8)
        faint = 128.0 + 0.15 * (picture - 128.0) + draw.normal(*picture.shape).numpy()
        _, png = cv2.imencode(".png", faint.round().clip(0.0, 255.0).astype(np.uint8))
        path.write_bytes(png.tobytes())  # under the name that the truth has

    _require_right(tr.load_capture(folder), tr.load_truth(folder), within=0.2)


def test_a_capture_that_a_windows_editor_saved_is_read(shared_case, tmp_path, part_of_tank):
    folder = part_of_tank(range(8))
    (folder / "capture.json").write_bytes((shared_case("14-capture-json-with-bom") / "capture.json").read_bytes())

    assert len(tr.load_capture(folder)) == 8


@pytest.mark.parametrize(("level", "within"), [(101.35, 0.0335), ("find", 0.06)])
def test_points_in_coordinates_of_a_map_keep_their_digits(shared_case, tmp_path, level, within):
    """The water stands at 101.35 m, where the true points fit the pixels; these pixels show that to 0.4 m only."""
    folder = shared_case("03-utm-points-ply")
    plane = PlaneOptions(offset=level)
    options = AdjustOptions(alignment=str(folder), out="run", survey=str(folder / "survey.json"), plane=plane)

    assert adjust_run(options, SilentRecorder(), tmp_path / "run")["warnings"] == []

    points, _ = load_points(tmp_path / "run" / "points.ply")
    truth = torch.from_numpy(np.loadtxt(folder / "truth_points.csv", delimiter=","))[:, 1:]
    model = read_colmap(tmp_path / "run" / "colmap").points
    error = torch.cdist(points - truth[0], truth - truth[0]).amin(dim=1)
    assert float((points - model).abs().max()) < 1e-6
    assert len(points[:, 1].unique()) == len(points) == 250
    assert float(error.square().mean().sqrt()) < within


def test_a_stated_position_that_is_wrong_is_named_and_does_no_harm(shared_case, tmp_path):
    folder = shared_case("03-utm-points-ply")
    survey = json.loads((folder / "survey.json").read_text())
    survey["images"]["DJI_0003.JPG"]["center"][0] += 3.0
    (tmp_path / "survey.json").write_text(json.dumps(survey))
    plane = PlaneOptions(offset=101.35)
    options = AdjustOptions(alignment=str(folder), out="run", survey=str(tmp_path / "survey.json"), plane=plane)

    metrics = adjust_run(options, SilentRecorder(), tmp_path / "run")

    (warning,) = metrics["warnings"]
    assert (warning["code"], warning["images"]) == ("position_contradicts", ["DJI_0003.JPG"])
    assert metrics["camera_shift_max_unit"] < 0.3


def _require_right(capture, truth, within=0.15):
    """All registered, and the cameras where they were (cm)."""
    scene = tr.reconstruct(capture, tr.Options(features=SiftOptions(max_features=800)))

    assert bool(scene.views.registered.all())
    assert evaluate(scene, truth)[0]["camera_rms_cm"] < within
