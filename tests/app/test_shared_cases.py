"""Photographs with which something was stated wrongly, from the files to what is said in the end."""

import json
import shutil

import pytest

CONTRADICTED = {
    "02-heights-offset": ("height_contradicts", [], "too large by 20 cm"),
    "04-gravity-one-image-flipped": ("gravity_contradicts", ["cam02.jpg"], "cam02.jpg is 55."),
    "11-gravity-one-image-15deg": ("gravity_contradicts", ["cam04.jpg"], "15.3 degrees"),
}
MIXED_UP = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0)}


def _run(torchrefrac, folder, *more):
    return torchrefrac("scene=capture", f"scene.path={folder}", "features.max_features=800", "out=run", *more)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTRADICTED)
def test_what_is_stated_wrongly_is_named_and_does_no_harm(torchrefrac, shared_case, metrics, tmp_path, name):
    ended = _run(torchrefrac, shared_case(name))

    assert ended.status == 0
    code, images, words = CONTRADICTED[name]
    found = metrics(tmp_path / "run")
    assert [(warning["code"], warning["images"]) for warning in found["warnings"]] == [(code, images)]
    assert words in found["warnings"][0]["message"]
    assert f"warning ({code}): " in ended.out
    assert found["registered_images"] == 5
    assert found["camera_rms_cm"] < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("axis", MIXED_UP)
def test_axes_that_are_mixed_up_in_all_images_are_found_out(torchrefrac, shared_case, metrics, tmp_path, axis):
    source = shared_case("02-heights-offset")
    content = json.loads((source / "capture.json").read_text())
    for image in content["images"]:
        image["height"] -= 20.0
        image["down_in_cam"] = [sign * part for sign, part in zip(MIXED_UP[axis], image["down_in_cam"], strict=True)]
    (tmp_path / "mixed_up").mkdir()
    (tmp_path / "mixed_up" / "capture.json").write_text(json.dumps(content))
    (tmp_path / "mixed_up" / "images").symlink_to(source / "images")
    shutil.copy(source / "truth.json", tmp_path / "mixed_up")

    assert _run(torchrefrac, tmp_path / "mixed_up").status == 0

    found = metrics(tmp_path / "run")
    assert [warning["code"] for warning in found["warnings"]] == ["gravity_contradicts"]
    assert found["camera_rms_cm"] < 0.15


@pytest.mark.slow
def test_near_nadir_without_gravity_the_vertical_is_right_to_what_is_said_of_it(
    torchrefrac, shared_case, metrics, tmp_path
):
    folder = shared_case("15-relief-nadir-no-gravity")

    assert torchrefrac("scene=capture", f"scene.path={folder}", "out=run").status == 0

    found = metrics(tmp_path / "run")
    assert [warning["code"] for warning in found["warnings"]] == ["gravity_undetermined"]
    assert found["camera_rotation_rms_deg"] < found["gravity_sigma_deg"]
    assert found["camera_rms_m"] < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("air", ["water=air", "model=none", "model=radial"])
def test_water_is_named_where_it_is_not_modelled(torchrefrac, part_of_tank, metrics, tmp_path, air):
    assert _run(torchrefrac, part_of_tank(range(5)), air).status == 0

    assert [warning["code"] for warning in metrics(tmp_path / "run")["warnings"]] == ["refraction_unmodelled"]


@pytest.mark.slow
@pytest.mark.parametrize("factor", [10.0, 3.0, 0.3])
def test_grossly_wrong_focal_lengths_are_what_is_named(torchrefrac, part_of_tank, metrics, tmp_path, factor):
    folder = part_of_tank(range(5))
    content = json.loads((folder / "capture.json").read_text())
    for name in ("fx", "fy"):
        content["intrinsics"][name] *= factor
    (folder / "capture.json").write_text(json.dumps(content))

    assert _run(torchrefrac, folder).status == 0

    (warning,) = metrics(tmp_path / "run")["warnings"]
    assert warning["code"] == "intrinsics_contradict"
    assert float(warning["message"].split("near ")[1].split()[0]) == pytest.approx(417.0, rel=0.1)
