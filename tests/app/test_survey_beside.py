"""What was measured on site beside the photographs: `survey.json` beside `capture.json`."""

import json
import math

import pytest
import torch

import torchrefrac as tr
from torchrefrac.commands.reconstruct import survey_of
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import heading_rotation

POINTS = ((-35.0, -30.0, -100.0), (40.0, -20.0, -100.0), (30.0, 45.0, -100.0), (-40.0, 40.0, -100.0))
LEVEL = 95.0
TURN, SHIFT = heading_rotation(torch.tensor(math.radians(30.0)).double()), torch.tensor((500.0, 200.0, LEVEL)).double()


def _write_survey(folder):
    """Four ground control points on the bottom of the tank, in a frame of their own, with the pixels of the truth."""
    capture, truth = tr.load_capture(folder), load_truth(folder)
    rows = [truth.names.index(name) for name in capture.names]
    water, lens = tr.FlatInterface(truth.index_ratio or 1.33), capture.intrinsics_of(0)
    camera = tr.RefractiveCamera(lens, truth.rotation[rows], truth.center[rows], water)
    marks = {}
    for i, point in enumerate(torch.tensor(POINTS, dtype=torch.float64)):
        pixels, _ = camera.project(point.expand(len(rows), 3))
        inside = lens.contains(pixels)
        seen = {name: at.tolist() for name, at, there in zip(capture.names, pixels, inside, strict=True) if there}
        marks[f"m{i}"] = {"observations": seen, "position": (TURN @ point + SHIFT).tolist(), "sigma": 0.02}
    path = folder / "survey.json"
    path.write_text(json.dumps({"format": "torchrefrac-survey/1", "pixel_origin": "corner", "marks": marks}))
    return path


def test_ground_control_beside_a_capture_gives_the_frame(torchrefrac, small_tank, metrics, tmp_path):
    _write_survey(small_tank)

    ended = torchrefrac("scene=capture", f"scene.path={small_tank}", "features.max_features=1500", "out=run")

    assert ended.status == 0, ended.err
    found = metrics(tmp_path / "run")
    assert found["warnings"] == []
    assert found["mark_rms_cm"] < 0.15
    assert list(found["mark_residuals_cm"]) == ["m0", "m1", "m2", "m3"]
    assert found["water_level_cm"] == pytest.approx(LEVEL, abs=0.3)
    assert found["camera_rms_cm"] < 0.1
    truth, cameras = load_truth(small_tank), tr.load_cameras(tmp_path / "run")
    wanted = truth.center[[truth.names.index(name) for name in cameras.names]] @ TURN.T + SHIFT
    lowered = torch.tensor((0.0, 0.0, found["water_level_cm"]))
    torch.testing.assert_close(cameras.center_in_world + lowered, wanted, rtol=0.0, atol=0.3)


def test_the_option_comes_before_the_file_beside_the_capture(small_tank, tmp_path):
    capture = tr.load_capture(small_tank)
    assert survey_of(capture, tr.Options()).control_names == ()

    path = _write_survey(small_tank)
    assert len(survey_of(capture, tr.Options()).control_names) == 4

    other = tmp_path / "other.json"
    other.write_text(path.read_text().replace('"m3"', '"m4"'))
    assert survey_of(capture, tr.Options(survey=str(other))).control_names[-1] == "m4"


def test_a_survey_of_other_images_is_refused_with_a_sentence(torchrefrac, small_tank):
    path = _write_survey(small_tank)
    path.write_text(path.read_text().replace("cam0", "DJI_0"))

    ended = torchrefrac("scene=capture", f"scene.path={small_tank}", "out=run")

    assert ended.status == 1
    assert "names the images DJI_00.jpg" in " ".join(ended.err.split())
    assert "but the scene has none of them" in " ".join(ended.err.split())


@pytest.mark.slow
def test_photographs_of_two_epochs_have_two_levels(torchrefrac, small_tank, metrics, tmp_path):
    content = json.loads((small_tank / "capture.json").read_text())
    content["format"] = "torchrefrac-capture/2"
    content["cameras"] = {"only": {"model": "opencv"} | content.pop("intrinsics")}
    for i, image in enumerate(content["images"]):
        image |= {"camera": "only", "epoch": ("may", "june")[i % 2]}
        image.pop("center_prior", None)
    (small_tank / "capture.json").write_text(json.dumps(content))
    given = f"scene.path={small_tank}", "features.max_features=1500"

    ended = torchrefrac("scene=capture", *given, "out=run")

    assert ended.status == 0, ended.err
    found = metrics(tmp_path / "run")
    assert found["warnings"] == []
    assert found["water_levels_cm"]["may"] == {"height": 0.0, "sigma": 0.0}
    june = found["water_levels_cm"]["june"]
    assert abs(june["height"]) < 3.0 * june["sigma"] < 0.3
    assert tr.load_cameras(tmp_path / "run").interface.plane.offset.unique().tolist() == sorted([0.0, june["height"]])
    dense = torchrefrac("scene=capture", *given, "dense=patch", "out=dense")
    assert dense.status == 0, dense.err
    surface = metrics(tmp_path / "dense")
    assert surface["dense_accuracy_within_0.5_cm"] > 0.98
    assert surface["dense_surface_median_cm"] < surface["dense_sigma_median_cm"]  # four photographs leave it so open
