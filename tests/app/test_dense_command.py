"""The dense stage as a person uses it: `dense=patch` in a run, and `torchrefrac densify` on the folder of one."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.app.conftest import run_command
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.cli.composed import densify_options
from torchrefrac.cli.conf import CONF
from torchrefrac.commands import dense_outputs, run_folder
from torchrefrac.commands import densify as densification
from torchrefrac.config import DensifyOptions, OptionError, Options, build
from torchrefrac.dense import DenseOptions, FolderStore
from torchrefrac.files.capture import load_capture
from torchrefrac.files.dense import load_dense, load_depth_map
from torchrefrac.files.raster import load_raster
from torchrefrac.files.truth import load_truth
from torchrefrac.refraction import FlatInterface
from torchrefrac.sweeps import comparison

DENSE_FILES = {"dense.ply", "dense", "dsm.npz", "dsm.png", "mesh.ply", "dense_view.png", "error_map.png"}
NAMES = ("cam00.jpg", "cam02.jpg", "cam04.jpg")
QUICK = ("dense=depthmap", "dense.cell=12")
PLAIN = (*QUICK, "outputs.mesh=false", "outputs.raster=false", "outputs.depth_maps=false")


def _prepare(sparse, folder, patch):
    """A copy of it, where the command runs; its pictures are empty, to save time."""
    shutil.copytree(sparse, folder, dirs_exist_ok=True)
    _change(folder / "run" / "metrics.json", lambda found: found.update(capture=str(folder / "capture")))
    for module in (dense_outputs, run_folder, comparison):
        for name in {name for name in vars(module) if name.startswith("draw_")}:
            patch.setattr(module, name, lambda *arguments: next(a for a in arguments if isinstance(a, Path)).touch())


@pytest.fixture
def place(sparse, tmp_path, monkeypatch):
    """Folder with `capture` and `run`, a sparse model, where the command runs."""
    _prepare(sparse, tmp_path, monkeypatch)
    return tmp_path


@pytest.fixture(scope="session")
def dense_run(made_once, sparse):
    """The folder of the run once `densify` with the options QUICK is through with it. Not to be changed."""

    def make(folder):
        with pytest.MonkeyPatch.context() as patch:
            _prepare(sparse, folder, patch)
            assert run_command(["densify", "run=run", *QUICK], folder, patch) == 0

    return made_once("dense_run", make) / "run"


@pytest.fixture
def interrupt(monkeypatch):
    """`interrupt()`: the next dense stage is interrupted when its first image is finished."""
    save = FolderStore.save

    def save_and_stop(store, image, patches):
        save(store, image, patches)
        monkeypatch.setattr(FolderStore, "save", save)
        raise KeyboardInterrupt

    return lambda: monkeypatch.setattr(FolderStore, "save", save_and_stop)


def _change(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_a_run_with_a_dense_stage_leaves_its_files_and_metrics(torchrefrac, sparse, metrics, tmp_path):
    capture = sparse / "capture"

    ended = torchrefrac("scene=capture", f"scene.path={capture}", "dense=patch", "dense.cell=8", "out=run")

    assert (ended.status, ended.err.count("error")) == (0, 0)
    run = tmp_path / "run"
    assert {path.name for path in run.iterdir()} >= DENSE_FILES | {"cameras.json", "points.ply", "side_view.png"}
    assert {path.name for path in (run / "dense").iterdir()} == {
        f"{name[:-4]}_depth.{end}" for name in NAMES for end in ("npz", "png")
    }
    found = metrics(run)
    assert (found["status"], found["stages"]) == ("complete", ["features", "matching", "sparse", "dense"])
    assert found["dense_method"] == "patch"
    cloud = load_dense(run / "dense.ply")
    assert 500 < len(cloud) == found["dense_points"] <= found["dense_patches"]
    assert found["dense_views_median"] == 3.0
    assert 0.9 < found["dense_score_median"] < 1.0
    assert 0.0 < found["dense_relative_sigma_median_cm"] < 0.2
    assert found["dense_relative_sigma_median_cm"] < found["dense_sigma_median_cm"] < 1.0
    assert found["dense_patches_per_s"] == pytest.approx(found["dense_patches"] / found["seconds_dense"], rel=0.01)
    assert found["dense_accuracy_within_0.5_cm"] > 0.4
    assert found["dense_plane_rms_cm"] < 1.0
    assert not any("completeness" in key for key in found)
    assert "dense (patch): " in ended.out
    assert " % of the points within 0.2 cm of the surface" in ended.out
    assert max(map(len, ended.out.splitlines())) <= 100
    depth_map = load_depth_map(run / "dense" / "cam02_depth.npz")
    assert (depth_map.name, depth_map.step, tuple(depth_map.valid.shape)) == ("cam02.jpg", 8, (30, 40))
    assert load_raster(run / "dsm.npz").valid.any()
    for picture in ("dense_view.png", "error_map.png", "dsm.png", "dense/cam02_depth.png"):
        assert cv2.imread(str(run / picture)).std() > 5
    events = EventAccumulator(str(run / "events"), size_guidance={"tensors": 1}).Reload()
    assert any(tag.startswith("dense") for tag in events.Tags()["tensors"])


@pytest.mark.parametrize("method", ["patch", "depthmap"])
def test_a_run_and_the_command_on_its_folder_give_the_same_cloud(
    torchrefrac, place, known_sparse, metrics, tmp_path, method
):
    arguments = (*PLAIN, f"dense={method}")
    run = torchrefrac("scene=capture", "scene.path=capture", *arguments, "out=whole")
    before = metrics(place / "run")

    ended = torchrefrac("densify", "run=run", *arguments)

    assert (run.status, ended.status, ended.err.count("error")) == (0, 0, 0)
    assert (tmp_path / "run" / "dense.ply").read_bytes() == (tmp_path / "whole" / "dense.ply").read_bytes()
    after = metrics(tmp_path / "run")
    assert {name: after[name] for name in before if name not in ("stages", "seconds_total", "peak_memory_gib")} == {
        name: value for name, value in before.items() if name not in ("stages", "seconds_total", "peak_memory_gib")
    }
    assert after["stages"] == [*before["stages"], "dense"]
    assert after["seconds_total"] > after["seconds_dense"] + before["seconds_sparse"]
    assert ended.out.startswith(f"dense ({method}): {after['dense_points']} points in ")
    assert (tmp_path / "run" / ".hydra" / "densify.yaml").is_file()
    assert {path.name for path in tmp_path.iterdir()} == {"capture", "run", "whole"}
    assert not (tmp_path / "run" / "dense").exists()


def test_an_interrupted_command_goes_on_with_what_is_finished(torchrefrac, place, dense_run, interrupt, metrics):
    run = place / "run"
    shutil.copytree(dense_run, run, dirs_exist_ok=True)
    whole = (run / "dense.ply").read_bytes()
    interrupt()

    stopped = torchrefrac("densify", "run=run", *QUICK)
    at_stop, files = metrics(run), {path.name for path in run.iterdir()}
    parts = {path.name for path in (run / "dense").rglob("*")}
    ended = torchrefrac("densify", "run=run", *QUICK)

    assert (stopped.status, ended.status) == (130, 0)
    assert (at_stop["status"], at_stop["stages"][-1]) == ("complete", "dense")
    assert files >= DENSE_FILES
    assert parts > {"parts", "made_from.txt", "patches_00000.npz", "cam00_depth.npz"}
    assert (run / "dense.ply").read_bytes() == whole
    assert (metrics(run)["status"], metrics(run)["dense_images_resumed"]) == ("complete", 1)
    assert "reason" not in metrics(run)
    assert "with 1 image from before" in ended.out.replace("\n  ", " ")
    assert not (run / "dense" / "parts").exists()


def test_processes_leave_the_same_cloud(torchrefrac, place, dense_run, monkeypatch):
    monkeypatch.setattr(densification, "MANY_VIEWS", 2)

    assert torchrefrac("densify", "run=run", "executor.workers=2", *QUICK).status == 0

    assert (place / "run" / "dense.ply").read_bytes() == (dense_run / "dense.ply").read_bytes()


def test_an_interrupted_command_on_a_run_that_was_not_dense_says_so(torchrefrac, place, interrupt, metrics):
    interrupt()

    stopped = torchrefrac("densify", "run=run", *QUICK)

    found = metrics(place / "run")
    assert (stopped.status, found["status"]) == (130, "interrupted")
    assert found["stages"] == ["features", "matching", "sparse"]
    assert found["camera_rms_cm"] > 0.0
    assert not any(name.startswith("dense_") for name in found)
    assert {path.name for path in (place / "run").iterdir()} & DENSE_FILES == {"dense"}
    assert {path.name for path in (place / "run" / "dense").rglob("*")} == {
        "parts", "made_from.txt", "patches_00000.npz",
    }  # fmt: skip


def test_an_interrupted_run_keeps_its_sparse_model_and_goes_on(
    torchrefrac, place, dense_run, known_sparse, interrupt, metrics
):
    command = ("scene=capture", "scene.path=capture", *PLAIN, "out=again")
    interrupt()

    stopped = torchrefrac(*command)
    at_stop, files = metrics(place / "again"), {path.name for path in (place / "again").iterdir()}
    ended = torchrefrac(*command)

    assert (stopped.status, ended.status) == (130, 0)
    assert (at_stop["status"], at_stop["stages"]) == ("interrupted", ["sparse"])
    assert files >= {"cameras.json", "points.ply", "tracks.npz", "side_view.png", "dense"}
    assert metrics(place / "again")["dense_images_resumed"] == 1
    assert (place / "again" / "dense.ply").read_bytes() == (dense_run / "dense.ply").read_bytes()


def test_other_options_do_not_go_on_with_old_parts(torchrefrac, place, interrupt, metrics):
    interrupt()
    torchrefrac("densify", "run=run", *QUICK)

    torchrefrac("densify", "run=run", *PLAIN, "dense.cell=10")

    assert metrics(place / "run")["status"] == "complete"
    assert "dense_images_resumed" not in metrics(place / "run")
    assert not (place / "run" / "dense").exists()


def test_a_folder_that_is_used_again_without_a_dense_stage_has_no_dense_results(
    torchrefrac, place, dense_run, known_sparse
):
    shutil.copytree(dense_run, place / "again")
    dense = {path.name for path in (place / "again").iterdir()} & DENSE_FILES

    torchrefrac("scene=capture", "scene.path=capture", "out=again")

    assert dense == DENSE_FILES
    assert not {path.name for path in (place / "again").iterdir()} & DENSE_FILES


def test_two_views_are_enough(torchrefrac, place, metrics):
    _change(place / "run" / "cameras.json", lambda c: c["images"][2].update(registered=False, reason="a test"))

    ended = torchrefrac("densify", "run=run", *QUICK)

    assert ended.status == 0
    assert {path.name for path in (place / "run" / "dense").glob("*.npz")} == {"cam00_depth.npz", "cam02_depth.npz"}
    assert metrics(place / "run")["dense_views_median"] == 2.0


def test_an_image_without_a_pose_may_leave_the_capture_and_others_may_join(torchrefrac, place):
    def rearrange(content):
        _, second, third = content["images"]
        content["images"] = [dict(third, name="new.jpg"), second, third]

    _change(place / "run" / "cameras.json", lambda c: c["images"][0].update(registered=False, reason="a test"))
    torchrefrac("densify", "run=run", *PLAIN)
    before = load_dense(place / "run" / "dense.ply")
    (place / "capture" / "images" / "cam00.jpg").rename(place / "capture" / "images" / "new.jpg")
    _change(place / "capture" / "capture.json", rearrange)

    ended = torchrefrac("densify", "run=run", *PLAIN)

    assert ended.status == 0
    after = load_dense(place / "run" / "dense.ply")
    assert torch.equal(after.points, before.points)
    assert torch.equal(after.reference, before.reference - 1)


def test_an_adjusted_run_is_made_dense_from_the_photographs_of_the_run(torchrefrac, place, metrics):
    torchrefrac("adjust", "alignment=run", "out=adjusted")

    ended = torchrefrac("densify", "run=adjusted", *QUICK)

    assert ended.status == 0
    assert metrics(place / "adjusted")["index_ratio"] == metrics(place / "run")["index_ratio"]
    assert metrics(place / "adjusted")["camera_rms_cm"] < 1.0
    assert metrics(place / "adjusted")["stages"] == ["adjusting", "dense"]
    assert {path.name for path in (place / "adjusted").iterdir()} >= DENSE_FILES | {"colmap", "water.json"}


def test_what_is_not_wanted_is_not_written(torchrefrac, place, dense_run):
    shutil.copytree(dense_run, place / "run", dirs_exist_ok=True)

    torchrefrac("densify", "run=run", *PLAIN)
    least = {path.name for path in (place / "run").iterdir()} & DENSE_FILES
    torchrefrac("densify", "run=run", *PLAIN[len(QUICK) + 1 :], "outputs.raster_cell=4")

    assert least == {"dense.ply", "dense_view.png", "error_map.png"}
    assert {path.name for path in (place / "run").iterdir()} & DENSE_FILES == least | {"mesh.ply"}


def test_a_geotiff_is_written_where_it_is_asked_for(torchrefrac, place):
    pytest.importorskip("rasterio")

    ended = torchrefrac("densify", "run=run", *PLAIN, "outputs.geotiff=true")

    assert ended.status == 0
    assert {path.stem for path in (place / "run").glob("*.tif")} == {
        "dsm", "depth", "sigma", "views", "hillshade", "orthophoto",
    }  # fmt: skip


def test_a_map_that_the_photographs_are_not_placed_in_is_not_stamped_on_files(torchrefrac, place):
    pytest.importorskip("rasterio")
    before = {path.name: path.stat().st_mtime_ns for path in (place / "run").iterdir()}

    ended = torchrefrac("densify", "run=run", *PLAIN, "outputs.geotiff=true", "outputs.crs=EPSG:32633")

    assert ended.status == 1
    assert "outputs.crs is 'EPSG:32633', but the capture does not say where its frame stands" in ended.err
    assert {path.name: path.stat().st_mtime_ns for path in (place / "run").iterdir()} == before


def test_a_raster_that_is_too_fine_does_not_cost_the_patches(torchrefrac, place, metrics):
    failed = torchrefrac("densify", "run=run", *QUICK, "outputs.raster_cell=1e-4")
    ended = torchrefrac("densify", "run=run", *PLAIN)

    assert failed.status == 1
    assert "error: outputs.raster_cell: cell_size is 0.0001, but makes " in failed.err
    assert (ended.status, metrics(place / "run")["dense_images_resumed"]) == (0, 3)


def test_without_truth_there_is_no_error_map(torchrefrac, place, metrics):
    (place / "capture" / "truth.json").unlink()

    ended = torchrefrac("densify", "run=run", *PLAIN)

    assert ended.status == 0
    assert (place / "run" / "dense_view.png").is_file()
    assert not (place / "run" / "error_map.png").exists()
    assert "dense_points" in metrics(place / "run")
    assert not any("accuracy" in name for name in metrics(place / "run"))


def _write_truth_points(folder, step=8):
    """What the true cameras see of the true planes at every few pixels, each ray against each plane."""
    truth, lens = load_truth(folder), load_capture(folder).cameras[0]
    x, y = (torch.arange(step // 2, size, step, dtype=torch.float64) for size in (lens.width, lens.height))
    pixels = torch.stack(torch.meshgrid(x + 0.5, y + 0.5, indexing="xy"), dim=-1)
    points, planes = [], []
    for rotation, center in zip(truth.rotation, truth.center, strict=True):
        camera = RefractiveCamera(Intrinsics(**vars(lens)), rotation, center, FlatInterface(1.33))
        origin, direction, _ = camera.cast_rays(pixels)
        away = truth.corner - origin[..., None, :]
        reach = (away * truth.normal).sum(dim=-1) / (direction[..., None, :] * truth.normal).sum(dim=-1)
        hit = origin[..., None, :] + reach[..., None] * direction[..., None, :]
        along = [
            ((hit - truth.corner) * edge).sum(dim=-1) / edge.square().sum(dim=-1) for edge in (truth.edge1, truth.edge2)
        ]
        inside = (reach > 0) & (torch.stack(along).amin(dim=0) >= 0) & (torch.stack(along).amax(dim=0) <= 1)
        nearest, plane = torch.where(inside, reach, torch.inf).min(dim=-1)
        found = origin + nearest[..., None] * direction
        points.append(torch.where(nearest.isfinite()[..., None], found, torch.nan))
        planes.append(torch.where(nearest.isfinite(), plane, -1))
    arrays = {"X": torch.stack(points).numpy(), "plane": torch.stack(planes).numpy()}
    np.savez(folder / "truth_points.npz", **arrays, step=np.array(step), offset=np.array(float(step // 2)))


def test_completeness_is_measured_where_true_points_are_known(torchrefrac, place, metrics):
    _write_truth_points(place / "capture")

    ended = torchrefrac("densify", "run=run", *PLAIN)

    assert ended.status == 0
    found = metrics(place / "run")
    assert 0.0 <= found["dense_completeness_within_0.1_cm"] < found["dense_completeness_within_0.5_cm"] < 1.0
    assert " % of the textured surface has one within 0.5 cm" in ended.out.replace("\n  ", " ")


def test_true_points_of_other_images_are_refused(torchrefrac, place):
    _write_truth_points(place / "capture")
    with np.load(place / "capture" / "truth_points.npz") as file:
        arrays = dict(file) | {"step": np.array(16)}
    np.savez(place / "capture" / "truth_points.npz", **arrays)

    ended = torchrefrac("densify", "run=run", *PLAIN)

    assert ended.status == 1
    assert "truth_points.npz: image is 320 x 240 pixels, but the true points need at least" in ended.err


def _remove(place, name):
    (place / name).unlink()


def _forget_image(place):
    _change(place / "capture" / "capture.json", lambda c: c["images"].pop(0))


def _other_size(place):
    for path in (place / "capture" / "images").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path))[:120])
    _change(place / "capture" / "capture.json", lambda c: c["intrinsics"].update(height=120))


def _write_masks(place, size, value):
    (place / "capture" / "masks").mkdir()
    for name in NAMES:
        cv2.imwrite(str(place / "capture" / "masks" / f"{name[:-4]}.png"), np.full(size, value, dtype=np.uint8))


def _write_small_masks(place):
    _write_masks(place, (48, 64), 255)


@pytest.mark.parametrize(
    ("harm", "arguments", "sentence"),
    [
        (None, [], "run is missing; give it on the command line as run=VALUE"),
        (None, ["run=nowhere"], "run is nowhere, which is no folder"),
        (None, ["run=capture"], "capture holds no cameras.json, so there is no sparse model to begin with"),
        (None, ["run=run", "capture=nowhere"], "nowhere is not a folder; give the folder that holds capture.json"),
        (None, ["run=run", "dense=none"], "dense.method is 'none', but must be patch or depthmap"),
        (None, ["run=run", "dense.method=best"], "dense.method is 'best', but must be one of none, patch, depthmap"),
        (None, ["run=run", "dense.window=4"], "dense.window is 4, but must be odd"),
        (None, ["run=run", "dense.cell=big"], "dense.cell is 'big', but must be a whole number"),
        (None, ["run=run", "outputs.raster_cell=0"], "outputs.raster_cell is 0, but must be finite and above 0"),
        (None, ["run=run", "outputs.geotiff=true"], "outputs.geotiff is true, but a GeoTIFF needs rasterio"),
        (lambda p: _remove(p, "run/tracks.npz"), ["run=run"], "run holds no tracks.npz, which a run has"),
        (lambda p: _remove(p, "run/metrics.json"), ["run=run"], "capture is missing, and run/metrics.json does not"),
        (
            lambda p: (p / "run/metrics.json").write_text("{"),
            ["run=run"],
            "run/metrics.json is damaged: Expecting",
        ),
        (lambda p: (p / "capture").rename(p / "moved"), ["run=run"], "the photographs of run were in "),
        (lambda p: _remove(p, "capture/images/cam02.jpg"), ["run=run"], "images/cam02.jpg does not exist"),
        (_forget_image, ["run=run"], "capture.json does not list cam00.jpg, whose pose is in run/cameras.json"),
        (_other_size, ["run=run"], "are 320x120, but those of run were 320x240; give those"),
        (_write_small_masks, ["run=run"], "masks/cam00.png is 64x48, but the images are 320x240; give it their size"),
    ],
)
def test_what_cannot_be_made_dense_is_one_sentence_and_nothing_is_changed(
    torchrefrac, place, monkeypatch, harm, arguments, sentence
):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    (place / "run" / "dense.ply").write_text("an earlier one")
    if harm is not None:
        harm(place)
    before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}

    ended = torchrefrac("densify", *arguments)

    assert ended.status == 1
    assert ended.err.startswith("error: ")
    assert sentence in ended.err
    assert ended.err.count("\n") == 1
    assert {path: path.read_bytes() for path in place.rglob("*") if path.is_file()} == before


def _stand_in_one_place(place):
    def move(content):
        for image in content["images"][1:]:
            image["center_in_world"] = content["images"][0]["center_in_world"]

    _change(place / "run" / "cameras.json", move)


def _forget_points(place):
    with np.load(place / "run" / "tracks.npz") as file:
        arrays = {name: value if name == "names" else value[:0] for name, value in file.items()}
    np.savez(place / "run" / "tracks.npz", **arrays)


@pytest.mark.parametrize(
    ("harm", "sentence"),
    [
        (_stand_in_one_place, "no two of 3 registered images see common points at an angle of more than 1 degree"),
        (_forget_points, "the scene has no sparse points, which say where to look"),
        (lambda p: _write_masks(p, (240, 320), 0), "no patch of the surface looks the same in several images"),
    ],
)
def test_a_dense_stage_that_fails_keeps_the_sparse_model_and_says_why(torchrefrac, place, metrics, harm, sentence):
    harm(place)

    ended = torchrefrac("densify", "run=run", *QUICK)

    assert ended.status == 1
    assert f"{sentence}" in ended.err
    assert "Traceback" not in ended.err
    found = metrics(place / "run")
    assert (found["status"], found["stages"]) == ("failed", ["features", "matching", "sparse"])
    assert sentence in found["reason"]
    assert found["registered_images"] == 3
    assert (place / "run" / "cameras.json").is_file()
    assert not (place / "run" / "dense.ply").exists()


def test_a_geotiff_without_rasterio_is_refused_before_a_run_begins(torchrefrac, place, metrics, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)

    ended = torchrefrac(
        "scene=capture", "scene.path=capture", "dense=patch", "outputs.geotiff=true", "out=new"
    )  # fmt: skip

    assert ended.status == 1
    assert metrics(place / "new")["stages"] == []
    assert "pip install torchrefrac[geo]" in metrics(place / "new")["reason"]


def test_a_sweep_over_the_models_compares_their_surfaces(both_models, metrics):
    folder, ended = both_models
    both = folder / "both"

    assert ended.status == 0
    runs = {name: metrics(both / name) for name in ("0_none", "1_refractive")}
    assert all(found["stages"][-1] == "dense" for found in runs.values())
    rms = {name: found["dense_plane_rms_cm"] for name, found in runs.items()}
    assert rms["0_none"] > 3.0 * rms["1_refractive"]
    table = (both / "table1.md").read_text()
    assert table.strip() in ended.out
    assert "within 0.2 cm" in table
    assert max(map(len, table.splitlines())) <= 100
    for picture in ("figure1.png", "dense_figure1.png", "dense_error_map.png"):
        assert cv2.imread(str(both / picture)).std() > 5


def test_a_sweep_over_the_methods_tells_them_apart(torchrefrac, place, known_sparse):
    ended = torchrefrac("-m", "scene=capture", "scene.path=capture", *PLAIN, "dense=none,patch,depthmap", "out=all")

    assert ended.status == 0
    labels = [line.split("|")[1].strip() for line in ended.out.splitlines() if line.startswith("| Refraction")]
    assert labels == ["Refraction", "Refraction, patch", "Refraction, depthmap", *labels[1:3]]


def _compose(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("densify", overrides=list(overrides))


def test_the_yaml_defaults_are_those_of_the_typed_options():
    assert densify_options(_compose("run=here")) == DensifyOptions("here")
    assert densify_options(_compose("run=here", "dense=depthmap")).dense == DenseOptions(method="depthmap")


def test_the_command_explains_itself(torchrefrac):
    told = torchrefrac("densify", "--help").out

    for words in ("torchrefrac densify run=DIR", "dense=depthmap", "outputs.mesh=true", "run=VALUE", "dense.cell=3"):
        assert words in told
    assert max(map(len, told.splitlines())) <= 100
    assert "torchrefrac densify run=DIR" in torchrefrac("--help").out


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"cell": 0}, "dense.cell is 0, but must be finite and at least 1"),
        ({"window": 1}, "dense.window is 1, but must be odd, so that it has a middle, and at least 3"),
        ({"min_views": 1}, "dense.min_views is 1, but must be finite and at least 2"),
        ({"min_views": 7}, r"dense.min_views is 7, but can be views \+ 1 = 6 at most"),
        ({"min_score": 1.0}, "dense.min_score is 1, but must lie between 0 and 1"),
        ({"angle_best": 60.0}, "dense.angle_best is 60, but must be below angle_max, 60"),
        ({"angle_max": 200.0}, "dense.angle_max is 200, but must be finite and at most 180"),
        ({"max_slant": 90.0}, "dense.max_slant is 90, but must be below 90 degrees"),
        ({"noise": 0.0}, "dense.noise is 0, but must be finite and above 0"),
        ({"iterations": -1}, "dense.iterations is -1, but must be finite and at least 0"),
        ({"interpolation": "nearest"}, "dense.interpolation is 'nearest', but must be one of bilinear, bicubic"),
        ({"sweep": {"planes": 1}}, "dense.sweep.planes is 1, but must be finite and at least 2"),
        ({"sweep": {"min_score": 0.0}}, "dense.sweep.min_score is 0, but must lie between 0 and 1"),
        ({"method": "depthmap", "levels": 2}, "dense.levels is 2, but a sweep in copies that are halved 2 times needs"),
        ({"device": "abacus"}, "dense.device is 'abacus', which PyTorch cannot use here: "),
        ({"cel": 3}, "dense.cel is not an option; known here are method, cell, window"),
    ],
)
def test_a_wrong_option_is_named(values, sentence):
    with pytest.raises(OptionError, match=sentence):
        build(Options, {"dense": values})


def test_files_of_a_surface_without_a_dense_stage_are_refused():
    with pytest.raises(OptionError, match=r"dense\.method is .none., but outputs\.geotiff, laz and contours are"):
        build(Options, {"outputs": {"contours": 0.5}})


def test_a_reference_system_without_a_geotiff_is_refused():
    with pytest.raises(OptionError, match=r"outputs\.crs is 'EPSG:32633', but no file has one"):
        build(Options, {"outputs": {"crs": "EPSG:32633"}})


def test_a_hidden_default_of_the_options_is_that_of_the_command():
    assert DensifyOptions("here").dense == replace(Options().dense, method="patch")
