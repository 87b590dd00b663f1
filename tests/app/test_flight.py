"""From photographs of a drone to a reconstruction, by two commands: real ones of a shore, and made ones of a river."""

import shutil

import pytest

from torchrefrac.synthetic.drone import ORIGIN

SMALLER = ("features=photographs", "features.max_pixels=1.44e6", "features.max_features=4000")


@pytest.fixture
def reconstructed(torchrefrac, metrics, tmp_path):
    """`reconstructed(photographs, *options)`: imports and reconstructs them; metrics. With the truth that lies beside
    the photographs, if any does."""

    def run(photographs, *options, truth=()):
        assert torchrefrac("import", f"photos={photographs}", "out=flight").status == 0
        for path in truth:
            shutil.copy(path, tmp_path / "flight")
        ended = torchrefrac("scene=capture", "scene.path=flight", "out=run", *options)
        assert ended.status == 0, ended.err
        return metrics(tmp_path / "run")

    return run


@pytest.mark.slow
@pytest.mark.parametrize(("water", "options"), [("air", SMALLER), ("fresh", SMALLER), ("fresh", ())])
def test_a_real_flight_over_a_shore_is_reconstructed_by_its_land(reconstructed, shared_data, water, options):
    found = reconstructed(shared_data("shore_flight") / "images", f"water={water}", *options)

    assert found["registered_images"] == 6
    assert found["points"] > 400
    assert found["reprojection_median_px"] < 0.5
    assert found["position_rms_m"] < 1.0
    assert found["heading_off_deg"] < 4.0
    assert [warning["code"] for warning in found["warnings"]] == ([] if water == "air" else ["no_refraction_seen"])
    (focal,) = (value for name, value in found.items() if name.endswith("focal_px"))
    (sigma,) = (value for name, value in found.items() if name.endswith("focal_sigma_px"))
    assert abs(focal - 2288.0) < 3.0 * sigma


@pytest.mark.slow
def test_a_made_flight_over_a_river_finds_the_level_of_the_water(torchrefrac, reconstructed, tmp_path):
    two = "scene.cameras=[{width:1024,height:768,fov_deg:65},{width:1024,height:768,fov_deg:50}]"
    made = ("scene=riverbed", two, "scene.columns=3", "scene.rows=3", "scene.obliques=4", "scene.metadata=drone")
    few = "features.max_features=2000"
    assert torchrefrac(*made, few, "cache=scenes", "out=made").status == 0
    (folder,) = (path for path in (tmp_path / "scenes").iterdir() if path.is_dir())

    found = reconstructed(folder / "images", few, truth=folder.glob("truth*"))

    assert found["registered_images"] == found["images"] == 13
    assert found["camera_rms_m"] < 0.01
    assert found["water_level_m"] == pytest.approx(ORIGIN[2], abs=0.02)
    assert found["position_rms_m"] < 0.06
    assert found["warnings"] == []
