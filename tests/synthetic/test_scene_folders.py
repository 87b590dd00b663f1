"""Folders of made scenes: what lies in them, that they are made once, and what happens when that goes wrong."""

import errno
import hashlib
import json
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from filelock import FileLock

from torchrefrac.camera import RefractiveCamera
from torchrefrac.files.capture import load_capture
from torchrefrac.files.survey import read_survey
from torchrefrac.files.truth import load_truth, load_truth_points
from torchrefrac.recorder import SilentRecorder
from torchrefrac.refraction import FlatInterface
from torchrefrac.synthetic.library import render_scene, scene_folder
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.stage import StageError


@pytest.fixture
def render(stage, options, tmp_path):
    """Renders the stage, or another, into a cache."""

    def render(cache=tmp_path / "cache", *, stage=stage, options=options):
        return render_scene(stage, options, cache, SilentRecorder())

    return render


@pytest.fixture
def taken(monkeypatch):
    """The numbers of the images that are rendered, in order."""
    numbers = []
    take = Photographer.take
    monkeypatch.setattr(Photographer, "take", lambda self, image: numbers.append(image) or take(self, image))
    return numbers


def failing_for(monkeypatch, failure, ending):
    """Writing a file whose name has that ending fails."""
    write = Path.write_bytes

    def fail(self, data):
        if f"{ending}." in self.name:
            raise failure
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", fail)


def test_the_folder_is_a_capture_with_its_survey_and_truth(render, stage, options):
    folder = render()

    capture, truth = load_capture(folder), load_truth(folder)
    assert capture.names == truth.names == ("cam00.png", "cam01.png", "cam02.png")
    assert capture.index_ratio == options.index_ratio
    assert capture.cameras[0].principal_point.tolist() == [24.0, 18.0]
    assert capture.has_heading.all()
    assert capture.has_height.tolist() == [True, False, False]
    assert float(capture.height[0]) == float(stage.center[0, 2])
    assert torch.equal(truth.rotation, stage.rotation)
    assert torch.equal(truth.center, stage.center)
    assert len(truth.corner) == 2
    survey = read_survey(folder / "survey.json", capture.names)
    assert survey.center.shape == (3, 3)
    said = json.loads((folder / "truth.json").read_text())
    assert said["index_ratio"] == options.index_ratio
    assert (folder / said["surface"]).is_file()
    assert json.loads((folder / "scene.json").read_text())["options"]["name"] == "pond"


def test_true_points_project_to_the_centres_of_their_pixels_and_lie_on_their_planes(render):
    folder = render()

    capture, truth = load_capture(folder), load_truth(folder)
    found = load_truth_points(folder, capture.names)
    cameras = RefractiveCamera(capture.cameras[0], truth.rotation, truth.center, FlatInterface(capture.index_ratio))
    pixels, _ = cameras[:, None, None].project(found.points)
    assert found.valid.double().mean() > 0.8
    assert float((pixels - found.pixels()).norm(dim=-1)[found.valid].max()) < 1e-4
    assert bool((found.pixels().frac() == 0.5).all())
    for plane in range(2):
        on_plane = found.points[found.plane == plane]
        assert len(on_plane) > 10
        assert float(((on_plane - truth.corner[plane]) @ truth.normal[plane]).abs().max()) < 1e-4
    assert bool((found.plane == -1)[found.valid].any())


def test_the_surface_on_disk_has_the_triangles_of_all_pieces(render, stage):
    trimesh = pytest.importorskip("trimesh")

    mesh = trimesh.load(render() / "truth_surface.ply", process=False)

    assert len(mesh.faces) == sum(len(piece.surface.triangles()[1]) for piece in stage.pieces)
    assert mesh.bounds[:, 2].tolist() == pytest.approx([-50.35, 15.35], abs=0.3)


def test_photographs_depend_on_the_options_alone_to_the_last_byte(render, options, tmp_path):
    first, second = render(tmp_path / "a"), render(tmp_path / "b")
    other = render(tmp_path / "a", options=replace(options, seed=8))

    assert first.name == second.name != other.name

    def digest(folder):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        return [(path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in files]

    assert digest(first) == digest(second)
    assert digest(first) != digest(other)


def test_photographs_on_disk_are_red_green_and_blue_in_that_order(render, stage, calm):
    folder = render(options=calm)

    stored = cv2.imread(str(folder / "images" / "cam01.png"))[:, :, ::-1]

    seen = Photographer.of(stage, calm).take(1).round().clamp(0.0, 255.0).numpy()
    assert np.array_equal(stored, seen)


def test_a_scene_that_is_there_is_not_rendered_again(render, taken):
    first = render()
    second = render()

    assert first == second
    assert taken == [0, 1, 2]


def test_an_interrupted_scene_goes_on_with_what_is_finished(render, taken, monkeypatch, options, tmp_path):
    whole = render(tmp_path / "other")
    taken.clear()
    with monkeypatch.context() as patched:
        failing_for(patched, KeyboardInterrupt(), "cam02")
        with pytest.raises(KeyboardInterrupt):
            render()
    assert not scene_folder(options, tmp_path / "cache").exists()
    (partial,) = (tmp_path / "cache").glob("*.partial")
    (partial / "images" / ".cam02.77.partial.png").write_bytes(b"half of it")
    taken.clear()

    folder = render()

    assert taken == [2]
    assert sorted(path.name for path in folder.rglob("*")) == sorted(path.name for path in whole.rglob("*"))
    for path in (whole / "images").iterdir():
        assert (folder / "images" / path.name).read_bytes() == path.read_bytes()
    assert not list((tmp_path / "cache").glob("*.partial"))


def test_a_full_disk_is_a_sentence_and_what_is_finished_stays(render, taken, monkeypatch):
    with monkeypatch.context() as patched:
        failing_for(patched, OSError(errno.ENOSPC, "No space left on device"), "cam01")
        with pytest.raises(StageError, match=r"pond_\w+ cannot be written: the disk is full; free space, or give"):
            render()
    taken.clear()

    render()

    assert taken == [1, 2]


def test_a_cache_that_may_not_be_written_is_a_sentence(render, monkeypatch):
    def refuse(self, *arguments, **others):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)

    with pytest.raises(StageError, match=r"no permission to write there; allow writing to .*cache, or give another"):
        render()


def test_a_cache_that_is_a_file_is_a_sentence(render, tmp_path):
    (tmp_path / "cache").write_text("not a folder")

    with pytest.raises(StageError, match="cannot be written: File exists; give another cache folder"):
        render()


def test_two_that_want_the_same_scene_render_it_once(render, taken):
    found = []
    threads = [threading.Thread(target=lambda: found.append(render())) for _ in range(2)]

    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert found[0] == found[1]
    assert taken == [0, 1, 2]


def test_the_one_who_waits_is_told_so(stage, taken, monkeypatch, options, tmp_path):
    notes = []
    folder = scene_folder(options, tmp_path)
    recorder = SilentRecorder()
    monkeypatch.setattr(recorder, "note", notes.append, raising=False)
    with FileLock(tmp_path / f".{folder.name}.lock"):  # as another process holds it that renders this scene
        waiting = threading.Thread(target=render_scene, args=(stage, options, tmp_path, recorder), daemon=True)
        waiting.start()
        while not notes:
            time.sleep(0.01)
    waiting.join()

    assert notes == [f"another process is rendering {folder.name}; waiting for it"]


def test_a_path_that_leaves_the_scene_is_refused_with_the_image(render, stage):
    center = stage.center.clone()
    center[2, 0] += 300.0

    with pytest.raises(StageError, match=r"scene pond: the camera path leaves the scene, cam02.png sees it in 0% of"):
        render(stage=replace(stage, center=center))


def test_a_camera_in_the_water_is_refused_with_its_height(render, stage):
    center = stage.center.clone()
    center[1, 2] = -4.0

    with pytest.raises(StageError, match=r"camera of cam01.png stands at z = -4 cm, but must stand above the water"):
        render(stage=replace(stage, center=center))


def test_a_scene_above_the_water_is_refused(render, stage, floor):
    raised = replace(floor, surface=replace(floor.surface, corner=floor.surface.corner + torch.tensor((0, 0, 51))))

    with pytest.raises(StageError, match="scene pond lies above the water: no camera sees anything below z = 0"):
        render(stage=replace(stage, pieces=(raised,)))


def test_a_lens_that_folds_the_image_is_refused(render, options):
    folding = replace(options, camera=replace(options.camera, distortion=(-2.0, 0.0, 0.0, 0.0, 0.0)))

    with pytest.raises(StageError, match=r"camera.distortion is \[-2.0, 0.0, 0.0, 0.0, 0.0\], but such a lens"):
        render(options=folding)


def test_a_camera_that_seems_to_look_at_the_sky_is_refused_before_it_is_rendered(render, options, taken):
    tilted = replace(
        options, plane_tilt_deg=(45.0, 0.0), inertial=replace(options.inertial, gravity_bias_deg=(-30.0, 0.0))
    )

    with pytest.raises(StageError, match=r"by its measured gravity cam0\d.png looks at the sky; point the"):
        render(options=tilted)
    assert taken == []
