"""Photographs of several cameras, some of which nobody has calibrated or levelled, from the command to the page."""

import json

import pytest

import torchrefrac as tr
from tests.app.mixed_cameras import write_mixed_cameras
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.features import SiftOptions
from torchrefrac.files.cameras import read_cameras

FEWER = "features.max_features=2000"


@pytest.fixture
def mixed(tmp_path):
    """`mixed(images, halves, turned, change)`: see `write_mixed_cameras`."""
    return lambda *arguments, **options: write_mixed_cameras(tmp_path / "mixed", *arguments, **options)


def stating(**changes):
    """A change of what is described of each camera."""
    return lambda camera: {**camera, **changes}


def test_photographs_of_half_the_size_and_turned_ones_are_placed(mixed, torchrefrac, metrics, tmp_path):
    mixed(range(4), halves=(1, 3), turned=(2, 3))

    ended = torchrefrac("scene=capture", "scene.path=mixed", "out=run", "features.max_features=600")

    found = metrics(tmp_path / "run")
    assert ended.status == 0
    assert (found["registered_images"], found["warnings"]) == (4, [])
    assert found["camera_rms_cm"] < 0.3
    assert found["reprojection_median_px"] < 0.1
    cameras = read_cameras(tmp_path / "run" / "cameras.json")
    assert cameras.cameras.names == ("640x480", "320x240", "480x640", "240x320")
    assert cameras.views.camera.tolist() == [0, 1, 2, 3]
    loaded = tr.load_cameras(tmp_path / "run")
    assert loaded.intrinsics.sizes[3].tolist() == [240.0, 320.0]


@pytest.mark.slow
def test_the_report_tells_of_all_sizes(mixed, torchrefrac, tmp_path):
    mixed(range(4), halves=(1, 3), turned=(2, 3))

    torchrefrac("scene=capture", "scene.path=mixed", "out=run", FEWER, reports=True)

    page = (tmp_path / "run" / "report.html").read_text()
    assert "1 of 640 \u00d7 480 and 1 of 320 \u00d7 240 and 1 of 480 \u00d7 640" in page


@pytest.mark.slow
def test_half_of_the_photographs_at_half_the_size_cost_a_factor_of_two(mixed):
    capture = tr.load_capture(folder := mixed(range(8), halves=(4, 5, 6, 7), turned=(1, 6)))

    scene = tr.reconstruct(capture)

    found, _ = evaluate(scene, tr.load_truth(folder))
    assert scene.views.num_registered == 8
    assert found["camera_rms_cm"] < 0.03


@pytest.mark.slow
def test_a_focal_length_that_nobody_knows_is_found(mixed, torchrefrac, metrics, tmp_path):
    guess = 1.2 * 640
    mixed(range(5), change=stating(fx=guess, fy=guess, sigma={"focal": 0.3}))

    ended = torchrefrac("scene=capture", "scene.path=mixed", "out=run", FEWER)

    found = metrics(tmp_path / "run")
    assert ended.status == 0
    assert (found["registered_images"], found["warnings"]) == (5, [])
    assert found["camera_640x480_focal_px"] == pytest.approx(417.032, rel=2e-3)
    assert found["camera_640x480_focal_sigma_px"] < 1.0
    assert found["camera_rms_cm"] < 0.1
    assert found["determined"][0].startswith("focal length, relative: determined to 0.0")


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.6, 1.2, 2.0])
def test_a_focal_length_that_nobody_knows_is_found_over_the_range_of_lenses(shared_data, tmp_path, factor):
    source = shared_data("tank")
    content = json.loads((source / "capture.json").read_text())
    lens = content.pop("intrinsics")
    guess = factor * lens["width"]
    content["cameras"] = {"phone": {**lens, "fx": guess, "fy": guess, "sigma": {"focal": 0.3}}}
    content |= {"format": "torchrefrac-capture/2", "folder": str(source / "images")}
    (tmp_path / "capture.json").write_text(json.dumps(content))

    scene = tr.reconstruct(tr.load_capture(tmp_path))

    assert scene.views.num_registered == 12
    assert float(scene.cameras.focal[0, 0]) == pytest.approx(lens["fx"], rel=1e-3)
    assert evaluate(scene, tr.load_truth(source))[0]["camera_rms_cm"] < 0.05


@pytest.mark.slow
def test_a_camera_that_is_farther_off_than_it_states_is_named(mixed, torchrefrac, metrics, tmp_path):
    def misstate(camera):
        wrong = {"fx": 1.05 * camera["fx"], "fy": 1.05 * camera["fy"], "sigma": {"focal": 0.005}}
        return {**camera, **wrong} if camera["width"] == 320 else camera

    mixed(range(5), halves=(1, 3), change=misstate)

    torchrefrac("scene=capture", "scene.path=mixed", "out=run", FEWER)

    found = metrics(tmp_path / "run")
    (warning,) = (each for each in found["warnings"] if each["code"] == "intrinsics_contradict")
    assert warning["message"].startswith("the focal length of 320x240 is 20")
    assert found["camera_320x240_focal_px"] == pytest.approx(208.5, rel=0.01)
    assert "camera_640x480_focal_px" not in found


@pytest.mark.slow
def test_gravity_of_some_photographs_is_enough(mixed):
    folder = mixed(range(5))
    content = json.loads((folder / "capture.json").read_text())
    for image in (1, 2, 4):
        del content["images"][image]["down_in_cam"]
    (folder / "capture.json").write_text(json.dumps(content))

    options = tr.Options(features=SiftOptions(max_features=2000))
    scene = tr.reconstruct(capture := tr.load_capture(folder), options)

    assert capture.down_sigma.isinf().tolist() == [False, True, True, False, True]
    assert scene.views.num_registered == 5
    assert evaluate(scene, tr.load_truth(folder))[0]["camera_rms_cm"] < 0.1


@pytest.mark.slow
def test_a_made_scene_may_have_two_cameras(torchrefrac, metrics, tmp_path):
    cameras = "[{width:320,height:240,fov_deg:75},{width:180,height:240,fov_deg:60,quarter_turns:1}]"

    ended = torchrefrac(
        "scene=tank", "scene.images=4", f"scene.cameras={cameras}", "scene.sensor.samples=1",
        "features.max_features=1000", "out=run",
    )  # fmt: skip

    found = metrics(tmp_path / "run")
    assert ended.status == 0
    assert found["registered_images"] == 4
    assert found["camera_rms_cm"] < 0.5
    assert found["point_median_cm"] < 1.0
    (folder,) = (tmp_path / "cache").glob("tank_*")
    capture = tr.load_capture(folder)
    assert capture.cameras.sizes == ((320, 240), (180, 240))
    assert capture.camera.tolist() == [0, 1, 0, 1]
