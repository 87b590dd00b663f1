"""Runs side by side: the table says which is which, whatever was run."""

import json
import shutil

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.files.cameras import write_cameras, write_points
from torchrefrac.files.dense import write_dense
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Rigid
from torchrefrac.scene import DenseCloud, Interfaces, Observations, Scene
from torchrefrac.sweeps.comparison import compare

COMPLETE = {
    "status": "complete", "images": 8, "registered_images": 8, "points": 50, "reprojection_median_px": 0.1,
    "seconds_total": 9.0, "camera_rms_cm": 0.01234, "surface_median_cm": 0.5,
}  # fmt: skip


@pytest.fixture
def make_run(tmp_path, draw):
    """`make_run(name, model, capture)`: a finished run folder; other fields of metrics.json as given."""
    truth = load_truth(embedded_scene("tank_small"))

    def make(name, model="refractive", capture="tank", **fields):
        capture = tmp_path / capture
        capture.mkdir(exist_ok=True)
        shutil.copy(embedded_scene("tank_small") / "truth.json", capture)
        run = tmp_path / "runs" / name
        points = draw.uniform(-100.0, -50.0, 50, 3)
        colors = torch.zeros(50, 3, dtype=torch.uint8)
        ratio = 1.33 if model == "refractive" else 1.0
        scene = Scene.create(
            Rigid(truth.rotation, truth.center), Intrinsics.create(640, 480, 417.0), Interfaces.level(ratio), points,
            Observations.none(), names=truth.names, length_unit="cm",
        )  # fmt: skip
        write_cameras(scene, run / "cameras.json")
        write_points(points, colors, run / "points.ply")
        metrics = COMPLETE | {"model": model, "capture": str(capture)} | fields
        (run / "metrics.json").write_text(json.dumps(metrics))
        return run

    return make


def test_one_scene_gets_one_figure_and_a_line_a_model(make_run, tmp_path):
    runs = [make_run("0", "none"), make_run("1", "refractive")]
    table = compare(runs, tmp_path)
    assert [line.split("|")[1].strip() for line in table.splitlines()[2:]] == ["No refraction", "Refraction"]
    assert "0.0123" in table
    assert {p.name for p in tmp_path.glob("*1*")} == {"table1.md", "figure1.png"}
    assert (tmp_path / "table1.md").read_text() == table + "\n"


def test_several_scenes_are_named_and_get_a_figure_each(make_run, tmp_path):
    table = compare([make_run("0", capture="tank"), make_run("1", capture="pond")], tmp_path)
    assert "tank: Refraction" in table
    assert "pond: Refraction" in table
    assert {p.name for p in tmp_path.glob("figure*")} == {"figure1_tank.png", "figure1_pond.png"}


def test_runs_that_differ_in_something_else_are_told_apart_by_their_folder(make_run, tmp_path):
    table = compare([make_run("0_refractive"), make_run("1_refractive")], tmp_path)
    assert "Refraction [0_refractive]" in table
    assert "Refraction [1_refractive]" in table


def test_a_failed_run_has_its_line_before_the_others_and_no_panel(make_run, tmp_path):
    failed = tmp_path / "runs" / "1"
    failed.mkdir(parents=True)
    (failed / "metrics.json").write_text(json.dumps({"status": "failed", "model": "none", "reason": "no images"}))
    table = compare([make_run("0"), failed], tmp_path)
    assert [cell.strip() for cell in table.splitlines()[2].split("|")[1:3]] == ["No refraction", "failed"]
    assert (tmp_path / "figure1.png").is_file()


def test_a_comparison_of_failures_alone_draws_nothing(tmp_path):
    failed = tmp_path / "runs" / "0"
    failed.mkdir(parents=True)
    (failed / "metrics.json").write_text(json.dumps({"status": "failed", "model": "none", "reason": "no images"}))
    assert "failed" in compare([failed], tmp_path)
    assert not list(tmp_path.glob("figure*"))


DENSE = {
    "dense_method": "patch", "dense_points": 1234567, "dense_accuracy_within_0.2_cm": 0.9567,
    "dense_completeness_within_0.5_cm": 0.81, "dense_surface_median_cm": 0.05, "dense_plane_rms_cm": 0.0456,
    "dense_plane_inliers": 0.97, "dense_patches_per_s": 12345.6, "seconds_dense": 123.4,
}  # fmt: skip


@pytest.fixture
def make_dense_run(make_run, draw):
    """`make_dense_run(name, model, ...)`: the same with a dense cloud."""

    def make(name, model="refractive", capture="tank", **fields):
        run = make_run(name, model, capture, **DENSE | fields)
        points, numbers = draw.uniform(-100.0, -50.0, 40, 3), draw.uniform(0.5, 1.0, 40)
        counts = torch.zeros(40, dtype=torch.long)
        cloud = DenseCloud(
            points, draw.directions(40), points.to(torch.uint8), numbers, numbers, counts, counts, numbers, "cm"
        )
        write_dense(cloud, run / "dense.ply")
        return run

    return make


def test_dense_runs_get_a_table_and_figures_of_their_own(make_run, make_dense_run, tmp_path):
    runs = [make_run("0", "none"), make_dense_run("1", "radial"), make_dense_run("2", "refractive")]

    table = compare(runs, tmp_path)

    sparse, dense = table.split("\n\n")
    assert [line.split("|")[1].strip() for line in sparse.splitlines()[2:]] == [
        "No refraction", "Radial distortion, patch", "Refraction, patch",
    ]  # fmt: skip
    cells = [cell.strip() for cell in dense.splitlines()[2].split("|")[1:-1]]
    assert cells == ["Radial distortion, patch", "1234567", "95.7 %", "81.0 %", "0.0456", "12346", "123.4"]
    assert max(map(len, dense.splitlines())) <= 100
    assert {path.name for path in tmp_path.glob("*.png")} == {"figure1.png", "dense_figure1.png", "dense_error_map.png"}


def test_dense_runs_without_truth_have_no_errors_to_show(make_dense_run, tmp_path):
    run = make_dense_run("0")
    (tmp_path / "tank" / "truth.json").unlink()
    known = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(
        json.dumps({name: value for name, value in known.items() if not name.endswith(("_cm", "_inliers"))})
    )

    table = compare([run], tmp_path)

    assert [cell.strip() for cell in table.splitlines()[-1].split("|")[1:-1]] == [
        "Refraction", "1234567", "12346", "123.4",
    ]  # fmt: skip
    assert {path.name for path in tmp_path.glob("*.png")} == {"figure1.png", "dense_figure1.png"}


def test_dense_figures_of_several_scenes_are_named_after_them(make_dense_run, tmp_path):
    compare([make_dense_run("0", capture="tank"), make_dense_run("1", capture="pond")], tmp_path)

    assert {path.name for path in tmp_path.glob("dense_*")} == {
        f"dense_{kind}_{scene}.png" for kind in ("figure1", "error_map") for scene in ("tank", "pond")
    }


def test_a_run_that_cannot_be_read_counts_as_failed_and_the_others_are_shown(make_run, tmp_path):
    runs = [make_run("0", "none"), make_run("1", "radial"), make_run("2", "refractive")]
    (runs[0] / "metrics.json").write_text('{"status": "comp')
    (runs[1] / "points.ply").unlink()

    table = compare(runs, tmp_path)

    cells = [[cell.strip() for cell in line.split("|")[1:3]] for line in table.splitlines()[2:]]
    assert cells == [["unknown", "failed"], ["Radial distortion", "0.0123"], ["Refraction", "0.0123"]]
    assert (tmp_path / "figure1.png").is_file()


def test_captures_in_a_cache_are_called_by_their_scene(make_run, tmp_path):
    runs = [
        make_run(f"{scene}_{model}", model, f"{scene}_0123abcd", scene=scene)
        for scene in ("tank", "cans")
        for model in ("none", "refractive")
    ]

    table = compare(runs, tmp_path)

    assert "tank: No refraction" in table
    assert "0123abcd" not in table
    assert {path.name for path in tmp_path.glob("*.png")} == {"figure1_tank.png", "figure1_cans.png"}


def test_scenes_in_different_units_have_theirs_beside_the_numbers(make_run, tmp_path):
    in_metres = {"camera_rms_cm": None, "surface_median_cm": None, "camera_rms_m": 0.5, "surface_median_m": 0.25}
    run = make_run("1", capture="pond", **in_metres)
    kept = {name: value for name, value in json.loads((run / "metrics.json").read_text()).items() if value is not None}
    (run / "metrics.json").write_text(json.dumps(kept))

    table = compare([make_run("0"), run], tmp_path)

    assert [cell.strip() for cell in table.splitlines()[0].split("|")[2:4]] == ["camera RMS", "off surface"]
    assert [cell.strip() for cell in table.splitlines()[3].split("|")[2:4]] == ["0.5000 m", "0.2500 m"]


@pytest.fixture
def make_ratio_run(make_run):
    """`make_ratio_run(name, model, ratio)`: a run of a scene that was rendered with this index ratio."""

    def make(name, model, ratio):
        said = {"scene": "tank", "model": model, "scene.index_ratio": ratio}
        return make_run(name, model, f"tank_{ratio.replace('.', '')}", scene="tank", overrides=said)

    return make


def test_what_else_was_varied_is_in_the_names_of_the_figures_and_there_is_no_table_1(make_ratio_run, tmp_path):
    (tmp_path / "table1.md").write_text("of an earlier sweep")
    runs = [
        make_ratio_run(f"{ratio}_{model}", model, ratio) for ratio in ("1.2", "1.5") for model in ("none", "refractive")
    ]

    assert compare(runs, tmp_path) == ""

    assert {path.name for path in tmp_path.glob("*1*.*")} == {"figure1_tank_1.2.png", "figure1_tank_1.5.png"}


def test_a_capture_with_one_run_has_no_figure_beside_those_that_have_several(make_ratio_run, tmp_path):
    compare([make_ratio_run("0", "none", "1.2"), *(make_ratio_run(m, m, "1.5") for m in ("none", "radial"))], tmp_path)

    assert [path.name for path in tmp_path.glob("*.png")] == ["figure1_tank_1.5.png"]


def test_more_runs_than_fit_side_by_side_have_a_table_and_no_figure(make_run, tmp_path):
    table = compare([make_run(str(i)) for i in range(7)], tmp_path)

    assert len(table.splitlines()) == 9
    assert not list(tmp_path.glob("*.png"))
