"""Made scenes in full, through the command: how wrong a run is is known, and refraction is what makes it right."""

import csv
import json
import math
import re
import shutil

import numpy as np
import pytest
import torch
import trimesh

from torchrefrac.camera import RefractiveCamera
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.evaluate.point_errors import true_places
from torchrefrac.evaluate.true_surface import TrueSurface
from torchrefrac.files.ply import read_vertices
from torchrefrac.files.tracks import read_run
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry.polygon import inside_polygon
from torchrefrac.refraction import FlatInterface
from torchrefrac.synthetic import CameraOptions, SensorOptions, TableOptions, made_scene

CLEARLY = 50.0
"""How many times the other models must be worse."""

FEWER = "features.max_features=4000"
"""Half of what a run has else: matching takes a quarter of the time."""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """A cache that these tests share: the option that says so."""
    return f"cache={tmp_path_factory.mktemp('scenes')}"


@pytest.fixture
def run(torchrefrac, rendered, metrics, tmp_path):
    """The metrics of a run with these arguments, which must succeed."""

    def run(*arguments):
        ended = torchrefrac(*arguments, rendered, "out=run")
        assert ended.status == 0, ended.err
        return metrics(tmp_path / "run")

    return run


@pytest.fixture
def sweep(torchrefrac, rendered, metrics, tmp_path):
    """The metrics of the jobs of a prepared sweep, which must all succeed, in their order."""

    def sweep(*arguments):
        ended = torchrefrac(*arguments, rendered, "out=runs")
        assert ended.status == 0, ended.err
        with (tmp_path / "runs" / "summary.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        found = [metrics(path.parent) for path in sorted((tmp_path / "runs").glob("*/metrics.json"))]
        assert len(rows) == len(found)
        return found

    return sweep


def _write_stone(path):
    """A bumpy ball of a metre, as of a stone."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    x, y, z = ball.vertices.T
    bumps = 0.08 * np.sin(5.0 * x + 1.0) * np.sin(4.0 * y) + 0.05 * np.sin(7.0 * z + 2.0 * x)
    ball.vertices *= 0.5 * (1.0 + bumps)[:, None]
    ball.export(path)


@pytest.mark.slow
def test_the_paper_s_table_comes_out_of_a_scene_that_is_made(sweep):
    none, radial, refractive = sweep("sweep=paper_table1")

    assert [found["model"] for found in (none, radial, refractive)] == ["none", "radial", "refractive"]
    for found in (none, radial, refractive):
        assert found["registered_images"] == found["images"] == 12
        assert found["true_index_ratio"] == 1.333
    assert refractive["camera_rms_cm"] < 0.02
    for key in ("camera_rms_cm", "point_median_cm"):
        assert min(none[key], radial[key]) > CLEARLY * refractive[key], key


@pytest.mark.slow
def test_the_paper_s_experiments_come_out_of_one_command(sweep, tmp_path):
    found = sweep("sweep=paper", FEWER)

    tank = {each["model"]: each for each in found if each["scene"] == "tank"}
    assert set(tank) == {"none", "radial", "bundler", "refractive"}
    assert len(found) == 8
    for each in found:
        assert each["registered_images"] == each["images"], (each["scene"], each["model"])
    for model in ("none", "radial", "bundler"):
        assert tank[model]["camera_rms_cm"] > CLEARLY * tank["refractive"]["camera_rms_cm"], model
    assert tank["bundler"]["camera_rms_cm"] < tank["radial"]["camera_rms_cm"] < tank["none"]["camera_rms_cm"]
    page = (tmp_path / "runs" / "paper.html").read_text(encoding="utf-8")
    assert "What is missing" not in page
    for number in (1, 3, 5, 6):
        assert f"Figure {number}. " in page
        assert (tmp_path / "runs" / f"paper_figure{number}.pdf").is_file()


@pytest.mark.slow
def test_the_error_of_a_wrong_index_ratio_grows_on_both_sides_of_the_true_one(sweep):
    found = sweep("sweep=index_error", "features.max_features=3000")

    assumed = [each["index_ratio"] for each in found]
    assert assumed == pytest.approx([1.283, 1.313, 1.323, 1.333, 1.343, 1.353, 1.383])
    for key in ("camera_rms_cm", "point_median_cm"):
        errors = [each[key] for each in found]
        below, above = errors[3::-1], errors[3:]
        assert below == sorted(below), (key, errors)
        assert above == sorted(above), (key, errors)
        assert min(errors[2], errors[4]) > 2.0 * errors[3], (key, errors)


@pytest.mark.slow
def test_packets_in_a_tank_are_reconstructed(run):
    found = run("scene=cans", FEWER)

    assert found["registered_images"] == found["images"] == 18
    assert found["camera_rms_cm"] < 0.04
    assert found["point_median_cm"] < 0.1


@pytest.mark.slow
def test_a_river_s_bed_is_reconstructed_with_its_satellite_positions(run):
    found = run("scene=riverbed", FEWER)

    assert found["registered_images"] == found["images"] == 22
    assert found["camera_rms_m"] < 0.03
    assert found["point_median_m"] < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True])
def test_steep_waves_are_named_and_make_everything_as_uncertain_as_it_is(run, moving):
    slope = 0.03
    found = run("scene=tank", f"scene.waves.rms_slope={slope}", f"scene.waves.moving={moving}", FEWER)

    assert [warning["code"] for warning in found["warnings"]] == ["surface_not_flat"]
    named = float(re.search(r"slope of ([\d.]+) degrees", found["warnings"][0]["message"]).group(1))
    assert 1 / 1.5 < math.radians(named) / slope < 1.5
    assert found["registered_images"] == found["images"] == 12
    assert found["camera_error_over_sigma"] < 2.0
    assert found["point_error_over_sigma"] < 2.0


@pytest.mark.slow
def test_a_mesh_of_one_s_own_is_reconstructed(run, tmp_path):
    _write_stone(tmp_path / "stone.ply")

    found = run("scene=mesh", f"scene.file={tmp_path / 'stone.ply'}", FEWER)

    assert found["registered_images"] == found["images"] == 16
    assert found["camera_rms_m"] < 0.005
    assert found["point_median_m"] < 0.005
    assert found["flatness_m"] < 0.005


@pytest.mark.slow
def test_photographs_of_another_renderer_leave_cameras_as_wrong_as_our_own(run, shared_data):
    theirs = run("scene=capture", f"scene.path={shared_data('tank')}")
    ours = run("scene=tank")

    assert (theirs["registered_images"], ours["registered_images"]) == (12, 12)
    for found in (theirs, ours):
        assert 0.0 < found["camera_rms_cm"] < 0.02


@pytest.fixture(scope="module")
def table(made_once):
    """A rendered table of eight photographs, and its true extent of the water in each photograph, pixels."""

    def make(folder):
        camera, sensor = CameraOptions(width=640, height=480), SensorOptions(samples=2)
        made = made_scene(TableOptions(name="table", images=8, camera=camera, sensor=sensor), folder / "cache")
        shutil.copytree(made, folder / "silent")
        shutil.copytree(made, folder / "stated")
        truth, path = load_truth(made), folder / "stated" / "capture.json"
        assert truth is not None
        assert truth.water_extent is not None
        corners = torch.nn.functional.pad(truth.water_extent, (0, 1))
        straight = RefractiveCamera(truth.intrinsics, truth.rotation, truth.center, FlatInterface(1.0))
        pixels, _ = straight[:, None].project(corners)
        content = json.loads(path.read_text())
        for image, extent in zip(content["images"], pixels.tolist(), strict=True):
            image["water_extent"] = extent
        path.write_text(json.dumps(content))

    return made_once("table", make)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["silent", "stated"])
def test_a_table_around_a_basin_is_seen_straight(torchrefrac, metrics, tmp_path, table, kind):
    ended = torchrefrac("scene=capture", f"scene.path={table / kind}", "out=run")
    assert ended.status == 0, ended.err

    found = metrics(tmp_path / "run")
    codes = [warning["code"] for warning in found["warnings"]]
    assert codes == ([] if kind == "stated" else ["points_outside_water"])
    assert found["registered_images"] == 8
    assert found["camera_rms_cm"] < 0.1
    scene, truth = read_run(tmp_path / "run"), load_truth(table / "silent")
    assert truth is not None
    _, alignment = evaluate(scene, truth)
    places = true_places(scene, TrueSurface(truth))
    assert alignment is not None
    assert places is not None
    outside = places.known & ~inside_polygon(places.points[:, :2], 1.01 * truth.water_extent)
    below = places.points[:, 2] < -1.0
    assert int((outside & below).sum()) > 150
    assert scene.outside_water()[outside & below].double().mean() > 0.98
    inside = places.known & inside_polygon(places.points[:, :2], 0.97 * truth.water_extent)
    assert scene.outside_water()[inside].double().mean() < 0.005
    assert found["points_outside_water"] == pytest.approx(int((outside & below).sum()), rel=0.1)
    error = (alignment.apply(scene.points) - places.points).norm(dim=-1)
    sigma = torch.from_numpy(read_vertices(tmp_path / "run" / "points.ply")[0]["sigma"].copy())
    of_all = (error / (3.0**0.5 * sigma))[outside & below]
    assert of_all.median() < 3.0
    assert error[outside & below].median() < 1.5 * error[inside].median()
