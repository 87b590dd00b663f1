"""`tracks.npz` beside `cameras.json`: a run is read back as the scene it was."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.files.two_cameras import BENT, assert_same, two_camera_scene
from torchrefrac.files.cameras import write_cameras
from torchrefrac.files.colmap.model import write_colmap
from torchrefrac.files.tracks import read_run, read_scene, write_tracks
from torchrefrac.scene import Assessment, Cameras, Interfaces, SceneError


@pytest.fixture
def scene(draw):
    """Five views, of which the second is not registered, though a point still lists it."""
    scene = two_camera_scene(draw)
    covariance = torch.eye(3, dtype=torch.float64) * draw.uniform(1.0, 2.0, 4, 1, 1)
    registered = torch.tensor([True, False, True, True, True])
    return replace(
        scene,
        cameras=Cameras.of([BENT]),
        views=replace(scene.views, camera=torch.zeros(5, dtype=torch.long), registered=registered),
        interfaces=Interfaces.level(1.333),
        length_unit="cm",
        failures={"left/1.jpg": "sees nothing"},
        assessment=Assessment(center_covariance=covariance),
    )


@pytest.fixture
def run(tmp_path, scene):
    write_cameras(scene, tmp_path / "cameras.json")
    write_tracks(scene, tmp_path / "tracks.npz")
    return tmp_path


@pytest.fixture
def change_tracks(run):
    """Applies `change` to the arrays of tracks.npz."""

    def apply(change):
        arrays = dict(np.load(run / "tracks.npz"))
        change(arrays)
        np.savez(run / "tracks.npz", **arrays)

    return apply


@pytest.fixture
def change_cameras(run):
    """Applies `change` to the content of cameras.json."""

    def apply(change):
        content = json.loads((run / "cameras.json").read_text())
        change(content)
        (run / "cameras.json").write_text(json.dumps(content))

    return apply


def finished(scene):
    return scene.of_views(scene.views.registered).cleaned()


def test_a_run_is_read_back_to_the_last_bit_without_views_that_are_not_registered(run, scene):
    found = read_scene(run)

    assert found.views.names == ("left/0.jpg", "left/2.jpg", "left/3.jpg", "left/4.jpg")
    assert_same(found, finished(scene))


def test_a_run_has_its_views_that_are_not_registered_too_and_what_is_known_of_them(run, scene):
    found = read_run(run)

    assert_same(finished(found), finished(scene))
    assert found.views.names == scene.views.names
    assert torch.equal(found.views.registered, scene.views.registered)
    assert bool(found.views.registered[found.observations.view].all())
    assert found.failures == scene.failures
    assert torch.equal(found.assessment.center_covariance, scene.assessment.center_covariance)


def test_tracks_of_a_scene_and_of_its_registered_views_read_the_same(run, scene):
    write_tracks(finished(scene), run / "tracks.npz")

    assert_same(read_scene(run), finished(scene))


def test_the_archive_holds_plain_arrays(run, scene):
    with np.load(run / "tracks.npz", allow_pickle=False) as archive:
        assert sorted(archive) == ["colors", "image", "names", "pixels", "point", "points"]
        assert tuple(archive["names"]) == scene.views.names


def test_a_folder_is_read_as_what_it_holds(run, tmp_path, draw):
    model = two_camera_scene(draw)
    write_colmap(model, tmp_path / "model" / "sparse" / "0")

    assert len(read_scene(run).views) == 4
    assert read_scene(tmp_path / "model").views.names == model.views.names


def test_a_run_goes_before_a_model_and_half_a_run_does_not(run, draw):
    write_colmap(two_camera_scene(draw), run)
    assert len(read_scene(run).views) == 4

    (run / "tracks.npz").unlink()
    assert len(read_scene(run).views) == 5


def test_a_folder_that_holds_neither_says_what_was_looked_for(tmp_path):
    with pytest.raises(SceneError, match=r"holds no run: looked for cameras.json and tracks.npz; .* cameras, images"):
        read_scene(tmp_path)
    with pytest.raises(SceneError, match="nowhere is not a folder"):
        read_scene(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["cameras.json", "tracks.npz"])
def test_half_a_run_is_named(run, name):
    (run / name).unlink()

    with pytest.raises(SceneError, match=f"holds no {name}"):
        read_scene(run)


@pytest.mark.parametrize("size", [0, 10, 1000, -10, -400])
def test_a_truncated_archive_is_refused(run, size):
    whole = (run / "tracks.npz").read_bytes()
    (run / "tracks.npz").write_bytes(whole[:size])

    with pytest.raises(SceneError, match=r"tracks.npz is not a whole NumPy archive"):
        read_run(run)


def test_an_archive_of_something_else_is_refused(run):
    with (run / "tracks.npz").open("wb") as file:
        np.save(file, np.zeros(3))

    with pytest.raises(SceneError, match=r"tracks.npz is not a whole NumPy archive"):
        read_run(run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("colors"), "tracks.npz lacks colors"),
        (lambda a: a.update(image=a["image"] + 1), "tracks.npz: image runs from 1 to 5, but must lie in 0 to 4"),
        (lambda a: a.update(point=a["point"][::-1]), "tracks.npz: point does not ascend"),
        (
            lambda a: a.update(image=a["image"].astype(float)),
            r"tracks.npz: image is float64 \(\d+,\), but must be whole numbers \(k\)",
        ),
        (lambda a: a.update(points=a["points"][0]), r"tracks.npz: points is float64 \(3,\), but must be .* \(n, 3\)"),
        (lambda a: a.update(pixels=a["pixels"] * np.inf), "tracks.npz: pixels has a number that is not finite"),
        (
            lambda a: a.update(pixels=a["pixels"][1:]),
            r"tracks.npz: pixels is float64 \(\d+, 2\), but must be numbers \(\d+, 2\)",
        ),
        (lambda a: a.update(names=a["names"][[0, 0, 2, 3, 4]]), "tracks.npz: names must be a list of different texts"),
        (lambda a: a.update(names=np.array(list("abcde"))), "tracks.npz lacks left/0.jpg, which cameras.json has"),
    ],
)
def test_tracks_that_cannot_be_right_are_refused(run, change_tracks, change, message):
    change_tracks(change)

    with pytest.raises(SceneError, match=message):
        read_run(run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(format="x"), "cameras.json: format is 'x', but must be 'torchrefrac-cameras/1'"),
        (lambda c: c.update(pixel_origin="center"), "cameras.json: pixel_origin is 'center', but must be 'corner'"),
        (lambda c: c.update(index_ratio=0.5), "cameras.json: index_ratio is 0.5, but must be at least 1"),
        (lambda c: c["intrinsics"].update(fx=0), "cameras.json: intrinsics.fx is 0, but must be above 0"),
        (lambda c: c["images"][0].pop("registered"), r"images\[0\].registered is None, but must be true or false"),
        (lambda c: c["images"][0].pop("center_in_world"), r"images\[0\].center_in_world is missing"),
        (
            lambda c: c["images"][1].update(name="left/0.jpg"),
            r"images\[1\].name is 'left/0.jpg', which an image before",
        ),
        (lambda c: c["images"].pop(1), "tracks.npz has observations in left/1.jpg, which cameras.json lacks"),
    ],
)
def test_cameras_that_cannot_be_right_are_refused(run, change_cameras, change, message):
    change_cameras(change)

    with pytest.raises(SceneError, match=message):
        read_run(run)


def test_broken_json_is_named(run):
    (run / "cameras.json").write_text("{")

    with pytest.raises(SceneError, match=r"cameras.json is not valid JSON"):
        read_run(run)


def test_views_may_be_listed_in_another_order(run, scene, change_cameras):
    change_cameras(lambda content: content["images"].reverse())
    seen = replace(scene.observations, view=4 - scene.observations.view)

    assert_same(
        read_scene(run), finished(replace(scene, views=scene.views[torch.arange(4, -1, -1)], observations=seen))
    )


def test_repeated_observations_are_dropped(run, change_tracks, scene):
    def repeat_all(arrays):
        for name in ("image", "point", "pixels"):
            arrays[name] = arrays[name].repeat(2, axis=0)

    change_tracks(repeat_all)

    assert_same(read_scene(run), finished(scene))


def test_which_points_are_dry_is_read_back_with_them(tmp_path, scene):
    dry = torch.arange(len(scene.points)) % 3 == 0
    write_cameras(scene, tmp_path / "cameras.json")
    write_tracks(replace(scene, dry=dry), tmp_path / "tracks.npz")

    found = read_run(tmp_path)

    rows = (scene.points[:, None] == found.points).all(dim=-1).long().argmax(dim=0)
    assert found.dry is not None
    assert torch.equal(found.dry, dry[rows])
    assert 0 < int(found.dry.sum()) < len(found.points)


def test_a_run_without_dry_points_says_nothing_of_them(run):
    assert "dry" not in np.load(run / "tracks.npz")
    assert read_run(run).dry is None


def test_dry_must_be_truth_values_of_all_points(run, change_tracks):
    change_tracks(lambda arrays: arrays.update(dry=np.zeros(len(arrays["points"]) - 1, dtype=bool)))
    with pytest.raises(SceneError, match="dry is bool"):
        read_run(run)


def test_what_is_known_of_the_points_is_read_again(scene, run, draw):
    root = draw.normal(len(scene.points), 3, 3)
    covariance = root @ root.mT
    known = replace(scene.assessment, point_covariance=covariance, relative_covariance=0.25 * covariance)
    write_tracks(replace(scene, assessment=known), run / "tracks.npz")

    found = read_run(run)

    assert found.assessment.point_covariance.shape == (len(found.points), 3, 3)
    of = torch.cdist(found.points, scene.points).argmin(dim=1)
    torch.testing.assert_close(found.assessment.point_covariance, covariance[of], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found.assessment.relative_covariance, 0.25 * covariance[of], rtol=1e-6, atol=1e-6)
