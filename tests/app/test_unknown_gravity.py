"""Photographs without gravity, from the files to the summary."""

import json

import pytest

FEWER = "features.max_features=2000"


@pytest.fixture
def without_gravity(part_of_tank, half_of_tank):
    """`without_gravity(images, half=False)`: the folder of those images of the embedded scene, down_in_cam left out; at
    half their size where that is asked for."""

    def strip(images, half=False):
        folder = (half_of_tank if half else part_of_tank)(images)
        content = json.loads((folder / "capture.json").read_text())
        del content["down_in_cam_sigma_deg"]
        for image in content["images"]:
            del image["down_in_cam"]
        (folder / "capture.json").write_text(json.dumps(content))
        return folder

    return strip


@pytest.mark.parametrize("images", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_gravity_is_estimated_and_the_summary_says_how_well(torchrefrac, without_gravity, metrics, tmp_path, images):
    ended = torchrefrac("scene=capture", f"scene.path={without_gravity(range(images))}", FEWER, "out=run")
    assert ended.status == 0
    found = metrics(tmp_path / "run")
    assert found["stages"] == ["features", "levelling", "matching", "sparse"]
    assert found["gravity"] == "estimated"
    assert 0.5 <= found["gravity_sigma_deg"] < 1.0
    assert f"determined to {found['gravity_sigma_deg']:.1f} degrees" in ended.out
    assert found["registered_images"] == images
    assert found["camera_rms_cm"] <= 0.05


def test_a_model_without_refraction_has_no_use_for_gravity(torchrefrac, without_gravity, metrics, tmp_path):
    folder = without_gravity([0, 2, 4], half=True)
    ended = torchrefrac("scene=capture", f"scene.path={folder}", "model=none", "out=run")
    assert ended.status == 0
    found = metrics(tmp_path / "run")
    assert found["stages"] == ["features", "matching", "sparse"]
    assert found["gravity"] == "unknown"
    assert "gravity_sigma_deg" not in found
    assert found["registered_images"] == 3


def test_measured_gravity_is_reported_as_such(complete_run, metrics):
    found = metrics(complete_run[0])
    assert (found["gravity"], found["gravity_sigma_deg"]) == ("measured", 0.5)
