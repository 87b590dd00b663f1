"""`torchrefrac adjust` as a person uses it: a reconstruction in files goes in, a better one comes out."""

import json
from dataclasses import replace

import pytest
import torch
from hydra import compose, initialize_config_dir

from tests.planted_reconstructions import plant_reconstruction
from torchrefrac.cli.composed import adjust_options
from torchrefrac.cli.conf import CONF
from torchrefrac.commands import adjust as readjustment
from torchrefrac.config import AdjustOptions, OptionError, PlaneOptions, build
from torchrefrac.files.cameras import load_points, read_cameras, write_cameras
from torchrefrac.files.colmap.model import read_colmap, write_colmap
from torchrefrac.files.tracks import read_scene, write_tracks
from torchrefrac.files.water import read_water, write_water
from torchrefrac.geometry import Similarity, levelling, so3_exp
from torchrefrac.scene import Interfaces
from torchrefrac.sfm.frame import transformed

RESULTS = {
    "run.log",
    "colmap",
    "water.json",
    "points.ply",
    "cameras.json",
    "tracks.npz",
    "metrics.json",
    "events",
    ".hydra",
}


@pytest.fixture
def planted(make_basin, draw):
    """Six cameras above 150 points, 0.3 pixels of noise."""
    return plant_reconstruction(make_basin(cameras=6, points=150, seen_by=3), draw, noise=0.3)


@pytest.fixture
def given(planted, draw, tmp_path):
    """Folder of the reconstruction that a pinhole makes of it, as text."""
    write_colmap(planted.as_of_a_pinhole(draw), tmp_path / "given")
    return tmp_path / "given"


def _write_truth(planted, folder):
    """`truth.json` of the cameras, in centimetres."""
    views = planted.truth.views
    poses = zip(views.names, views.rotation.tolist(), views.center.tolist(), strict=True)
    images = [{"name": n, "cam_from_world_rotation": r, "center_in_world": c} for n, r, c in poses]
    folder.mkdir(exist_ok=True)
    (folder / "truth.json").write_text(json.dumps({"length_unit": "cm", "images": images}))


def _water(folder):
    """The one surface in the water.json of a folder."""
    return read_water(folder / "water.json", ())[0]


def _write_survey(path, images=None, marks=None):
    content = {"format": "torchrefrac-survey/1", "images": images or {}, "marks": marks or {}}
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_a_colmap_model_goes_in_and_comes_out_right(torchrefrac, planted, draw, metrics, tmp_path, kind):
    write_colmap(planted.as_of_a_pinhole(draw), tmp_path / "given" / "sparse" / "0", binary=kind == "binary")
    _write_truth(planted, tmp_path / "given")

    ended = torchrefrac("adjust", "alignment=given", "index_ratio=1.33", f"format={kind}", "out=run")

    assert (ended.status, ended.err.count("error")) == (0, 0)
    run = tmp_path / "run"
    assert {path.name for path in run.iterdir()} == RESULTS
    ending = ".bin" if kind == "binary" else ".txt"
    assert {path.name for path in (run / "colmap").iterdir()} == {
        f"{n}{ending}" for n in ("cameras", "images", "points3D")
    }
    adjusted = read_colmap(run / "colmap")
    assert float(planted.off(adjusted).max()) < 0.2
    assert float(planted.off(read_scene(tmp_path / "given")).max()) > 0.5
    found = metrics(run)
    assert (found["status"], found["command"], found["adjustment"]) == ("complete", "adjust", "converged")
    assert (found["images"], found["adjusted_images"], found["points"]) == (6, 6, len(adjusted.points))
    assert found["reprojection_median_px"] < 1.0 < found["reprojection_median_before_px"]
    assert found["camera_rms_cm"] < 0.2
    assert 0.0 < found["camera_shift_median_unit"] <= found["camera_shift_max_unit"] < 5.0
    assert found["index_ratio_sigma"] is None
    assert found["held"] == {}
    assert any(line.startswith("scale, relative: not determined") for line in found["determined"])
    assert "6 of 6 images adjusted, 150 points (0 dropped)" in ended.out
    assert "against truth (4-dof alignment): cameras" in ended.out
    assert max(map(len, ended.out.splitlines())) <= 100


def test_points_carry_their_standard_deviations(torchrefrac, planted, given, tmp_path):
    torchrefrac("adjust", f"alignment={given}", "index_ratio=1.33", "out=run")

    header = (tmp_path / "run" / "points.ply").read_bytes().split(b"end_header")[0]
    points, colors = load_points(tmp_path / "run" / "points.ply")
    assert b"property float sigma" in header
    assert torch.equal(colors, planted.truth.colors)
    assert float((points - planted.truth.points).norm(dim=-1).median()) < 3.0


def test_the_result_is_a_reconstruction_that_can_be_adjusted_again(torchrefrac, planted, given, metrics, tmp_path):
    torchrefrac("adjust", f"alignment={given}", "index_ratio=1.33", "out=first")

    ended = torchrefrac("adjust", "alignment=first", "water.path=first/water.json", "out=second")

    assert ended.status == 0
    assert metrics(tmp_path / "second")["camera_shift_max_unit"] < 1e-3
    assert _water(tmp_path / "second").index_ratio == 1.33
    again = read_scene(tmp_path / "second")
    assert again.views.names == planted.truth.views.names
    torch.testing.assert_close(again.views.center, read_colmap(tmp_path / "second" / "colmap").views.center)


def test_the_index_ratio_is_found_where_it_may_vary(torchrefrac, planted, given, metrics, tmp_path):
    ended = torchrefrac("adjust", f"alignment={given}", "index_ratio=1.25", "bundle.refine=[index_ratio]", "out=run")

    assert ended.status == 0
    found = metrics(tmp_path / "run")
    assert abs(found["index_ratio"] - 1.33) < 4.0 * found["index_ratio_sigma"] < 0.05
    assert _water(tmp_path / "run").index_ratio == found["index_ratio"]
    assert f"index ratio {found['index_ratio']:.4f} +- " in ended.out


def test_a_survey_fixes_the_scale(torchrefrac, planted, draw, metrics, tmp_path):
    pinhole, truth = planted.as_of_a_pinhole(draw), planted.truth.views
    smaller = pinhole.views.at(pinhole.views.rotation, 0.3 * pinhole.views.center)
    write_colmap(replace(pinhole, views=smaller, points=0.3 * pinhole.points), tmp_path / "given")
    heights = {
        name: {"height": float(center[2]), "height_sigma": 0.05}
        for name, center in zip(truth.names, truth.center, strict=True)
    }
    _write_survey(tmp_path / "survey.json", heights | {"other.jpg": {"height": 3.0, "height_sigma": 1.0}})

    ended = torchrefrac("adjust", "alignment=given", "index_ratio=1.33", "survey=survey.json", "out=run")

    assert ended.status == 0
    adjusted = read_colmap(tmp_path / "run" / "colmap")
    torch.testing.assert_close(adjusted.views.center[:, 2], truth.center[:, 2], rtol=0.0, atol=0.15)
    assert "images of the survey that the alignment does not have: other.jpg" in ended.out
    assert not any(line == "scale, relative: not determined" for line in metrics(tmp_path / "run")["determined"])


def test_marks_are_adjusted_too_but_are_not_in_the_model(torchrefrac, planted, given, metrics, tmp_path):
    marks, truth = {}, planted.truth
    for point in range(4):
        of_point = truth.observations[truth.observations.point == point]
        names = [truth.views.names[view] for view in of_point.view.tolist()]
        seen = dict(zip(names, of_point.pixels.tolist(), strict=True))
        marks[f"m{point}"] = {"observations": seen, "position": truth.points[point].tolist(), "sigma": 0.02}
    _write_survey(tmp_path / "survey.json", marks=marks)

    torchrefrac("adjust", f"alignment={given}", "index_ratio=1.33", "survey=survey.json", "out=run")

    adjusted = read_colmap(tmp_path / "run" / "colmap")
    assert len(adjusted.points) == 150
    torch.testing.assert_close(adjusted.views.center, truth.views.center, rtol=0.0, atol=0.5)
    assert metrics(tmp_path / "run")["marks"]["m3"] == pytest.approx(truth.points[3].tolist(), abs=0.1)


def test_several_cameras_and_interfaces_go_through(torchrefrac, make_basin, draw, metrics, tmp_path):
    planted = plant_reconstruction(make_basin(cameras=6, points=100, seen_by=3), draw, 0.2, intrinsics=2, interfaces=2)
    write_colmap(planted.as_of_a_pinhole(draw, 0.1), tmp_path / "given")
    write_water(planted.truth, tmp_path / "given" / "water.json")

    ended = torchrefrac("adjust", "alignment=given", "water.path=given/water.json", "out=run")

    assert ended.status == 0
    assert {path.name for path in (tmp_path / "run").iterdir()} == RESULTS
    adjusted = read_colmap(tmp_path / "run" / "colmap")
    assert [width for width, _ in adjusted.cameras.sizes] == [1024, 1040]
    assert torch.equal(adjusted.views.camera, planted.truth.views.camera)
    assert metrics(tmp_path / "run")["reprojection_median_px"] < 0.4
    _, interface = read_water(tmp_path / "run" / "water.json", adjusted.views.names)
    assert adjusted.views.names == planted.truth.views.names
    assert torch.equal(interface, planted.truth.views.interface)


def test_the_water_level_is_found(torchrefrac, planted, draw, metrics, tmp_path):
    pinhole = planted.as_of_a_pinhole(draw)
    up = pinhole.points.new_tensor((0.0, 0.0, 250.0))
    raised = pinhole.views.at(pinhole.views.rotation, pinhole.views.center + up)
    write_colmap(replace(pinhole, views=raised, points=pinhole.points + up), tmp_path / "given")
    _write_truth(planted, tmp_path / "truth")

    ended = torchrefrac("adjust", "alignment=given", "plane.offset=find", "index_ratio=1.33", "truth=truth", "out=run")

    assert ended.status == 0
    assert metrics(tmp_path / "run")["camera_rms_cm"] < 0.2
    assert float(_water(tmp_path / "run").offset) == pytest.approx(250.0, abs=8.0)
    written = read_cameras(tmp_path / "run" / "cameras.json").interfaces
    assert torch.equal(written.offset, _water(tmp_path / "run").offset)


def test_a_wall_of_a_run_stays_a_wall_of_glass(torchrefrac, planted, draw, tmp_path):
    glass = {"layers": torch.tensor([[1.52]]).double(), "thickness": torch.tensor([[1.25]]).double()}
    truth = replace(planted.truth, interfaces=replace(planted.truth.interfaces, **glass, kinds=("wall",)))
    seen = truth.observations
    pixels, _ = truth.camera_of(seen.view).project(truth.points[seen.point])
    noisy = replace(seen, pixels=pixels + 0.1 * draw.normal(len(seen), 2))
    (tmp_path / "given").mkdir()
    write_cameras(truth, tmp_path / "given" / "cameras.json")
    write_tracks(replace(truth, observations=noisy), tmp_path / "given" / "tracks.npz")

    ended = torchrefrac("adjust", "alignment=given", "out=run")

    assert ended.status == 0, ended.err
    adjusted = read_cameras(tmp_path / "run" / "cameras.json")
    assert adjusted.interfaces.kinds == ("wall",)
    assert torch.equal(adjusted.interfaces.thickness, glass["thickness"])
    torch.testing.assert_close(adjusted.views.center, truth.views.center, rtol=0.03, atol=1.0)


def test_a_level_that_the_survey_states_takes_part(torchrefrac, planted, metrics, tmp_path):
    up, true = planted.truth.points.new_tensor((0.0, 0.0, 250.0)), planted.truth
    raised = true.views.at(true.views.rotation, true.views.center + up)
    write_colmap(replace(true, views=raised, points=true.points + up), tmp_path / "given")
    centers = zip(raised.names, raised.center.tolist(), strict=True)
    content = {
        "format": "torchrefrac-survey/1",
        "images": {name: {"center": center, "center_sigma": 0.1} for name, center in centers},
        "water_level": {"height": 250.0, "sigma": 0.01},
    }
    (tmp_path / "survey.json").write_text(json.dumps(content))

    ended = torchrefrac("adjust", "alignment=given", "index_ratio=1.33", "survey=survey.json", "out=run")

    assert ended.status == 0, ended.err
    assert float(_water(tmp_path / "run").offset) == pytest.approx(250.0, abs=0.03)
    assert metrics(tmp_path / "run")["warnings"] == []


def test_gauges_at_two_places_tilt_the_water(torchrefrac, planted, metrics, tmp_path):
    level_from_water = levelling(torch.nn.functional.normalize(torch.tensor((-0.004, 0.002, -1.0)).double(), dim=0))
    place = Similarity(torch.ones(()).double(), level_from_water, torch.tensor((0.0, 0.0, 250.0)).double())
    true = transformed(planted.truth, place)
    write_colmap(true, tmp_path / "given")
    centers = zip(true.views.names, true.views.center.tolist(), strict=True)
    gauges = place.apply(torch.tensor(((-60.0, 0.0, 0.0), (60.0, 0.0, 0.0), (0.0, 50.0, 0.0))).double()).tolist()
    content = {
        "format": "torchrefrac-survey/1",
        "images": {name: {"center": center, "center_sigma": 0.1} for name, center in centers},
        "gauges": {f"g{i}": {"height": z, "sigma": 0.01, "position": [x, y]} for i, (x, y, z) in enumerate(gauges)},
    }
    (tmp_path / "survey.json").write_text(json.dumps(content))

    ended = torchrefrac("adjust", "alignment=given", "index_ratio=1.33", "survey=survey.json", "out=run")

    assert ended.status == 0, ended.err
    found = metrics(tmp_path / "run")
    assert found["warnings"] == []
    assert found["water_slope_east_mm_per_m"] == pytest.approx(4.0, abs=0.3)
    assert found["water_slope_north_mm_per_m"] == pytest.approx(-2.0, abs=0.5)
    assert 0.0 < found["water_slope_east_sigma_mm_per_m"] < 0.2
    normal = _water(tmp_path / "run").normal[0]
    torch.testing.assert_close(normal, level_from_water[:, 2], rtol=0.0, atol=5e-4)
    assert "the water rises by" in ended.out


CAMERA_LINES = {
    3: "SIMPLE_PINHOLE 1024 768 667.0 512.0 384.0",
    7: "SIMPLE_RADIAL 1024 768 667.0 512.0 384.0 0.001",
    8: "RADIAL 1024 768 667.0 512.0 384.0 0.001 0.002",
    20: "OPENCV 1024 768 667.0 668.0 512.0 384.0 0.001 0.0 0.0005 0.0",
    21: "OPENCV_FISHEYE 1024 768 667.0 668.0 512.0 384.0 0.001 0.0 0.0 0.002",
    500: "FULL_OPENCV 1024 768 667.0 668.0 512.0 384.0 0.001 0.0 0.0 0.0 0.001 0.0 0.002 0.0",
}


def test_cameras_keep_their_model_and_ids_and_names_stay(torchrefrac, make_basin, draw, tmp_path):
    """Of a model whose ids are anything, in which two images share each camera."""
    basin = make_basin(cameras=12, points=150, seen_by=3)
    write_colmap(plant_reconstruction(basin, draw, 0.3).truth, tmp_path / "given")
    cameras, images = tmp_path / "given" / "cameras.txt", tmp_path / "given" / "images.txt"
    cameras.write_text("".join(f"{number} {line}\n" for number, line in CAMERA_LINES.items()))
    lines = [line for line in images.read_text().splitlines() if not line.startswith("#")]
    called = {str(i + 1): (str(90 - 7 * i), [*CAMERA_LINES][i // 2]) for i in range(12)}
    for i in range(0, len(lines), 2):
        words = lines[i].split(" ")
        words[0], words[8] = (str(one) for one in called[words[0]])
        lines[i] = " ".join(words)
    images.write_text("\n".join(lines) + "\n")
    points = tmp_path / "given" / "points3D.txt"
    rows = [line.split(" ") for line in points.read_text().splitlines() if not line.startswith("#")]
    rows = [[called[w][0] if i >= 8 and i % 2 == 0 else w for i, w in enumerate(row)] for row in rows]
    points.write_text("".join(" ".join(row) + "\n" for row in rows))

    def described(folder):
        text = (folder / "cameras.txt").read_text().splitlines(), (folder / "images.txt").read_text().splitlines()
        table, shown = ([line for line in of if not line.startswith("#")] for of in text)
        return sorted(table), sorted((w[0], w[8], w[9]) for w in (line.split(" ") for line in shown[::2]))

    ended = torchrefrac("adjust", "alignment=given", "index_ratio=1.33", "max_error=40", "rounds=1", "out=run")

    assert ended.status == 0, ended.err
    assert described(tmp_path / "run" / "colmap") == described(tmp_path / "given")


def _elsewhere(scene):
    """Another frame, and the scene in it."""
    turn = so3_exp(torch.tensor((1.1, -0.7, 2.0), dtype=torch.float64))
    change = Similarity(torch.tensor(0.05).double(), turn, torch.tensor((5.0, -3.0, 11.0)).double())
    return change, transformed(scene, change)


def test_a_model_in_a_frame_of_its_own_comes_into_that_of_the_survey(torchrefrac, planted, metrics, tmp_path):
    _, given = _elsewhere(planted.truth)
    write_colmap(given, tmp_path / "given")
    views = planted.truth.views
    where = zip(views.names, views.center.tolist(), strict=True)
    centers = {name: {"center": center, "center_sigma": 0.02} for name, center in where}
    _write_survey(tmp_path / "survey.json", centers)

    ended = torchrefrac("adjust", "alignment=given", "index_ratio=1.33", "survey=survey.json", "out=run")

    assert ended.status == 0, ended.err
    assert "brought into the frame of the survey" in " ".join(ended.err.split())
    found = metrics(tmp_path / "run")
    assert found["survey_scale"] == pytest.approx(20.0, rel=1e-3)
    assert found["survey_turn_deg"] > 90.0
    assert found["survey_shift_unit"] > 10.0
    assert (found["dropped_points"], found["warnings"]) == (0, [])
    adjusted = read_colmap(tmp_path / "run" / "colmap")
    torch.testing.assert_close(adjusted.views.center, views.center, rtol=0.0, atol=0.1)
    assert _water(tmp_path / "run").is_level


@pytest.mark.parametrize("gravity", [False, True])
def test_the_normal_of_the_water_is_found_in_any_frame(torchrefrac, planted, metrics, tmp_path, gravity):
    change, given = _elsewhere(planted.truth)
    write_colmap(given, tmp_path / "given")
    down = zip(planted.truth.views.names, (-planted.truth.views.rotation[:, :, 2]).tolist(), strict=True)
    images = {name: {"down_in_cam": of, "down_in_cam_sigma_deg": 0.5} for name, of in down}
    _write_survey(tmp_path / "survey.json", images)
    survey = ("survey=survey.json",) if gravity else ()

    find = ("plane.normal=find", "plane.offset=find")
    ended = torchrefrac("adjust", "alignment=given", "index_ratio=1.33", *find, *survey, "out=run")

    assert ended.status == 0, ended.err
    normal = _water(tmp_path / "run").normal[0]
    wanted = normal.new_tensor((0.0, 0.0, 1.0)) if gravity else change.rotation[:, 2]
    assert float((normal @ wanted).clamp(max=1.0).acos().rad2deg()) < 0.5
    assert any(line.startswith("tilt of the water") for line in metrics(tmp_path / "run")["determined"])
    assert metrics(tmp_path / "run")["held"] == {}


def test_a_normal_without_a_level_needs_a_survey(torchrefrac, given):
    ended = torchrefrac("adjust", f"alignment={given}", "plane.normal=find", "out=run")

    assert ended.status == 1
    assert "set plane.offset=find" in " ".join(ended.err.split())


def test_what_is_not_determined_is_held_and_said(torchrefrac, given, metrics, tmp_path):
    ended = torchrefrac("adjust", f"alignment={given}", "index_ratio=1", "bundle.refine=[plane_tilt]", "out=run")

    assert ended.status == 0
    told = "tilt of the water to the cameras: not determined"
    assert metrics(tmp_path / "run")["held"] == {"plane_tilt": told}
    assert f"not refined: {told}" in ended.out


def _save_run(scene, folder):
    """As a run without refraction leaves it, in centimetres: cameras.json and tracks.npz."""
    scene = replace(scene, interfaces=Interfaces.level(1.0), length_unit="cm")
    write_cameras(scene, folder / "cameras.json")
    write_tracks(scene, folder / "tracks.npz")


def test_a_run_is_adjusted_but_not_overwritten(torchrefrac, planted, draw, metrics, tmp_path):
    folder = tmp_path / "old"
    _save_run(planted.as_of_a_pinhole(draw), folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    refused = torchrefrac("adjust", "alignment=old", "out=old")
    ended = torchrefrac("adjust", "alignment=old", "index_ratio=1.33", "out=new")

    assert refused.status == 1
    assert "error: out is" in refused.err
    assert "where the alignment lies" in refused.err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert ended.status == 0
    assert float(planted.off(read_scene(tmp_path / "new")).max()) < 0.2
    assert "camera_shift_median_cm" in metrics(tmp_path / "new")


def test_a_model_that_no_run_has_written_is_not_overwritten(torchrefrac, given, planted, tmp_path):
    write_colmap(planted.truth, tmp_path / "mine" / "colmap")

    ended = torchrefrac("adjust", f"alignment={given}", "out=mine")

    assert ended.status == 1
    assert "holds a COLMAP model that no run has written" in ended.err
    assert torch.equal(read_colmap(tmp_path / "mine" / "colmap").points, planted.truth.points)


def test_a_folder_that_is_used_again_tells_of_the_last_adjustment_that_succeeded_only(torchrefrac, given, tmp_path):
    torchrefrac("adjust", f"alignment={given}", "index_ratio=1.33", "out=run")

    again = torchrefrac("adjust", f"alignment={given}", "plane.offset=0.5", "format=binary", "out=run")
    found = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    failed = torchrefrac("adjust", f"alignment={given}", "survey=none.json", "out=run")

    assert (again.status, failed.status) == (0, 1)
    assert {path.name for path in (tmp_path / "run").iterdir()} == RESULTS
    assert {path.name for path in (tmp_path / "run" / "colmap").iterdir()} == {
        "cameras.bin", "images.bin", "points3D.bin",
    }  # fmt: skip
    assert {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()} == found


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "alignment is missing; give it on the command line as alignment=VALUE"),
        (["alignment=nowhere"], "nowhere is not a folder"),
        (["alignment=given", "survey=none.json"], "none.json does not exist"),
        (["alignment=given", "water.path=none.json"], "none.json is not a file"),
        (["alignment=given", "truth=given"], "truth is given, but must be a folder that holds a truth.json"),
        (["alignment=given", "plane.offset=36"], "not above the water plane: cam00.jpg, cam02.jpg, cam04.jpg"),
        (["alignment=given", "plane.offset=deep"], "plane.offset is 'deep', but must be a number, or find"),
        (["alignment=given", "plane.normal=[0,0,0]"], "plane.normal is [0.0, 0.0, 0.0], but must be three numbers"),
        (["alignment=given", "plane.normal=[0,0,-1]", "plane.offset=find"], "the cameras are not above the points"),
        (["alignment=given", "index_ratio=0.9"], "index_ratio is 0.9, but must lie between 1 and 3"),
        (["alignment=given", "rounds=0"], "rounds is 0, but must be finite and at least 1"),
        (["alignment=given", "held=all"], "held is 'all', but must be one of none, cameras"),
        (["alignment=given", "format=xml"], "format is 'xml', but must be one of text, binary"),
        (["alignment=given", "bundle.refine=[depth]"], "bundle.refine[0] is 'depth', but must be one of focal"),
        (["alignment=given", "water.path=w.json", "plane.offset=1"], "water.path and plane are both given"),
    ],
)
def test_bad_input_is_one_sentence_a_failed_status_and_no_results(
    torchrefrac, given, metrics, tmp_path, arguments, sentence
):
    ended = torchrefrac("adjust", *arguments, "out=run")

    assert ended.status == 1
    assert f"error: {sentence}" in ended.err
    assert "Traceback" not in ended.err
    assert metrics(tmp_path / "run")["status"] == "failed"
    assert sentence in metrics(tmp_path / "run")["reason"]
    assert not RESULTS - {"metrics.json", "events", ".hydra", "run.log"} & {
        path.name for path in (tmp_path / "run").iterdir()
    }


def test_images_that_nothing_connects_are_named(torchrefrac, planted, metrics, tmp_path):
    truth = planted.truth
    near = truth.observations.view < 4
    wanted = torch.where(truth.observations.point % 2 == 0, near, ~near)
    write_colmap(replace(truth, accepted=wanted).trimmed().cleaned(), tmp_path / "given")

    ended = torchrefrac("adjust", "alignment=given", "out=run")

    assert ended.status == 1
    assert "error: no common points connect the images: 2 parts" in ended.err
    assert "cam04.jpg, cam05.jpg" in metrics(tmp_path / "run")["reason"]


def test_an_interrupt_is_told_of(torchrefrac, given, metrics, monkeypatch, tmp_path):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(readjustment, "readjust", interrupted)

    assert torchrefrac("adjust", f"alignment={given}", "out=run").status == 130
    assert metrics(tmp_path / "run")["status"] == "interrupted"


def test_both_commands_explain_themselves(torchrefrac):
    assert "torchrefrac adjust alignment=DIR" in torchrefrac("--help").out
    told = torchrefrac("adjust", "--help").out
    for words in ("plane.offset=find", "path of a survey.json", "bundle.loss_scale=0.5", "alignment=VALUE"):
        assert words in told
    assert "tank_small" not in told
    assert max(map(len, told.splitlines())) <= 100


def _compose(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("adjust", overrides=list(overrides))


def test_the_yaml_defaults_are_those_of_the_typed_options():
    found = adjust_options(_compose("alignment=here", "out=there"))

    assert found == AdjustOptions(alignment="here", out="there")


def test_the_water_level_is_a_number_or_find():
    found = [build(PlaneOptions, {"offset": value}, "plane").offset for value in (2, 2.5, "find")]

    assert found == [2.0, 2.5, "find"]
    assert isinstance(found[0], float)
    with pytest.raises(OptionError, match=r"plane.offset is None, but must be a number, or find"):
        build(PlaneOptions, {"offset": None}, "plane")
    with pytest.raises(OptionError, match=r"plane.offset is inf, but must be finite, or find"):
        build(PlaneOptions, {"offset": float("inf")}, "plane")


@pytest.mark.slow
def test_the_tank_that_was_reconstructed_without_refraction_is_put_right(torchrefrac, shared_data, metrics, tmp_path):
    tank = shared_data("tank")
    torchrefrac("scene=capture", f"scene.path={tank}", "model=none", "out=none")

    ended = torchrefrac(
        "adjust", "alignment=none", "plane.offset=find", "index_ratio=1.25", "bundle.refine=[index_ratio]",
        f"truth={tank}", "out=run",
    )  # fmt: skip

    assert ended.status == 0
    assert metrics(tmp_path / "none")["camera_rms_cm"] > 2.0
    assert metrics(tmp_path / "run")["camera_rms_cm"] < 0.15
    assert metrics(tmp_path / "run")["index_ratio"] == pytest.approx(1.33, abs=0.003)
