"""`tracks.npz` beside `cameras.json`: a run is read back as the alignment it was."""

import json

import numpy as np
import pytest
import torch

from tests.files.alignments import BENT, assert_same, two_lens_alignment
from torchrefrac.files.cameras import write_cameras
from torchrefrac.files.colmap.model import write_colmap
from torchrefrac.files.tracks import read_alignment, read_run, write_tracks
from torchrefrac.scene import Reconstruction
from torchrefrac.scene.alignment import Alignment, AlignmentError


@pytest.fixture
def reconstruction(draw):
    """Five images, of which the second is not registered, though a point still lists it."""
    alignment = two_lens_alignment(draw)
    return Reconstruction(
        names=alignment.names,
        registered=torch.tensor([True, False, True, True, True]),
        rotation=alignment.rotation,
        center=alignment.center,
        intrinsics=BENT,
        index_ratio=1.333,
        length_unit="cm",
        points=alignment.points,
        colors=alignment.colors,
        image=alignment.image,
        point=alignment.point,
        pixels=alignment.pixels,
        failures={"left/1.jpg": "sees nothing"},
    )


@pytest.fixture
def run(tmp_path, reconstruction):
    write_cameras(reconstruction, tmp_path / "cameras.json")
    write_tracks(reconstruction, tmp_path / "tracks.npz")
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


def test_a_run_is_read_back_to_the_last_bit_without_images_that_are_not_registered(run, reconstruction):
    alignment = read_run(run)

    assert alignment.names == ("left/0.jpg", "left/2.jpg", "left/3.jpg", "left/4.jpg")
    assert_same(alignment, Alignment.from_reconstruction(reconstruction))


def test_tracks_of_an_alignment_and_of_its_reconstruction_read_the_same(run, reconstruction):
    alignment = Alignment.from_reconstruction(reconstruction)

    write_tracks(alignment, run / "tracks.npz")

    assert_same(read_run(run), alignment)


def test_the_archive_holds_plain_arrays(run, reconstruction):
    with np.load(run / "tracks.npz", allow_pickle=False) as archive:
        assert sorted(archive) == ["colors", "image", "names", "pixels", "point", "points"]
        assert tuple(archive["names"]) == reconstruction.names


def test_a_folder_is_read_as_what_it_holds(run, tmp_path, draw):
    model = two_lens_alignment(draw)
    write_colmap(model, tmp_path / "model" / "sparse" / "0")

    assert len(read_alignment(run)) == 4
    assert read_alignment(tmp_path / "model").names == model.names


def test_a_run_goes_before_a_model_and_half_a_run_does_not(run, draw):
    write_colmap(two_lens_alignment(draw), run)
    assert len(read_alignment(run)) == 4

    (run / "tracks.npz").unlink()
    assert len(read_alignment(run)) == 5


def test_a_folder_that_holds_neither_says_what_was_looked_for(tmp_path):
    with pytest.raises(
        AlignmentError, match=r"holds no run: looked for cameras.json and tracks.npz; .* cameras, images"
    ):
        read_alignment(tmp_path)
    with pytest.raises(AlignmentError, match="nowhere is not a folder"):
        read_alignment(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["cameras.json", "tracks.npz"])
def test_half_a_run_is_named(run, name):
    (run / name).unlink()

    with pytest.raises(AlignmentError, match=f"holds no {name}"):
        read_alignment(run)


@pytest.mark.parametrize("size", [0, 10, 1000, -10, -400])
def test_a_truncated_archive_is_refused(run, size):
    whole = (run / "tracks.npz").read_bytes()
    (run / "tracks.npz").write_bytes(whole[:size])

    with pytest.raises(AlignmentError, match=r"tracks.npz is not a whole NumPy archive"):
        read_run(run)


def test_an_archive_of_something_else_is_refused(run):
    with (run / "tracks.npz").open("wb") as file:
        np.save(file, np.zeros(3))

    with pytest.raises(AlignmentError, match=r"tracks.npz is not a whole NumPy archive"):
        read_run(run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("colors"), "tracks.npz lacks colors"),
        (lambda a: a.update(image=a["image"] + 1), "tracks.npz: image runs from 1 to 5, but must lie in 0 to 4"),
        (lambda a: a.update(point=a["point"][::-1]), "tracks.npz: point is not ascending"),
        (
            lambda a: a.update(image=a["image"].astype(float)),
            "tracks.npz: image is float64 with 1 dimensions, but must be",
        ),
        (lambda a: a.update(points=a["points"][0]), "tracks.npz: points is float64 with 1 dimensions"),
        (lambda a: a.update(pixels=a["pixels"] * np.inf), "tracks.npz: pixels has a number that is not finite"),
        (lambda a: a.update(pixels=a["pixels"][1:]), "tracks.npz: pixels has shape"),
        (lambda a: a.update(names=a["names"][[0, 0, 2, 3, 4]]), "tracks.npz: names must be a list of different texts"),
        (lambda a: a.update(names=np.array(list("abcde"))), "tracks.npz lacks left/0.jpg, which cameras.json has"),
    ],
)
def test_tracks_that_cannot_be_right_are_refused(run, change_tracks, change, message):
    change_tracks(change)

    with pytest.raises(AlignmentError, match=message):
        read_run(run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(format="x"), "cameras.json: format is 'x', but must be 'torchrefrac-cameras/1'"),
        (lambda c: c.update(pixel_origin="center"), "cameras.json: pixel_origin is 'center', but must be 'corner'"),
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

    with pytest.raises(AlignmentError, match=message):
        read_run(run)


def test_broken_json_is_named(run):
    (run / "cameras.json").write_text("{")

    with pytest.raises(AlignmentError, match=r"cameras.json is not valid JSON"):
        read_run(run)


def test_images_may_be_listed_in_another_order(run, reconstruction, change_cameras):
    change_cameras(lambda content: content["images"].reverse())

    assert_same(read_run(run), Alignment.from_reconstruction(reconstruction))


def test_repeated_observations_are_dropped(run, change_tracks, reconstruction):
    def repeat_all(arrays):
        for name in ("image", "point", "pixels"):
            arrays[name] = arrays[name].repeat(2, axis=0)

    change_tracks(repeat_all)

    assert_same(read_run(run), Alignment.from_reconstruction(reconstruction))
