"""Keypoints and matches of a COLMAP database and of hloc."""

import sqlite3
import sys
from contextlib import closing

import numpy as np
import pytest
import torch

from torchrefrac.files.correspondences import read_correspondences
from torchrefrac.scene import CaptureError

NAMES, SIZES = ("b.jpg", "a.jpg", "c.jpg"), ((100, 80),) * 3
PIXELS = {"a.jpg": [[10.5, 20.25], [30.0, 40.0], [99.0, 79.0]], "b.jpg": [[1.0, 2.0], [3.0, 4.0]]}
MATCHES = [[2, 0], [0, 1]]  # of a.jpg and b.jpg, which is the first of NAMES


def _write(path, pixels=None, matches=None, columns=2, pair=2**31 + 1, table="matches"):
    """A database as COLMAP lays it out: a.jpg is image 1, b.jpg image 2."""
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
        for name in ("keypoints", "matches", "two_view_geometries"):
            key = "image_id" if name == "keypoints" else "pair_id"
            database.execute(f"CREATE TABLE {name} ({key} INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
        for image, (name, places) in enumerate((pixels or PIXELS).items(), start=1):
            database.execute("INSERT INTO images VALUES (?, ?)", (image, name))
            rows = np.zeros((len(places), columns), dtype=np.float32)
            rows[:, :2] = places
            database.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", (image, *rows.shape, rows.tobytes()))
        rows = np.array(MATCHES if matches is None else matches, dtype=np.uint32)
        database.execute(f"INSERT INTO {table} VALUES (?, ?, ?, ?)", (pair, *rows.shape, rows.tobytes()))
        database.commit()
    return path


def _require_right(found):
    assert [each.tolist() for each in found.pixels] == [PIXELS["b.jpg"], PIXELS["a.jpg"], []]
    assert {pair: rows.tolist() for pair, rows in found.matches.items()} == {(0, 1): [[0, 2], [1, 0]]}
    assert found.missing == ["c.jpg"]


@pytest.mark.parametrize("columns", [2, 4, 6])
@pytest.mark.parametrize("table", ["matches", "two_view_geometries"])
def test_a_database_is_read_with_images_in_any_order(tmp_path, columns, table):
    path = _write(tmp_path / "database.db", columns=columns, table=table)

    _require_right(read_correspondences(path, None, NAMES, SIZES))


def test_a_database_of_colmap_itself_is_read(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap, which writes COLMAP databases")
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        camera = database.write_camera(pycolmap.Camera(model="PINHOLE", width=100, height=80, params=[90, 90, 50, 40]))
        ids = {name: database.write_image(pycolmap.Image(name=name, camera_id=camera)) for name in PIXELS}
        for name, places in PIXELS.items():
            database.write_keypoints(ids[name], np.array(places, dtype=np.float32))
        database.write_matches(ids["a.jpg"], ids["b.jpg"], np.array(MATCHES, dtype=np.uint32))

    _require_right(read_correspondences(tmp_path / "database.db", None, NAMES, SIZES))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"pixels": {"x.jpg": [[1.0, 1.0]], "y.jpg": [[1.0, 1.0]]}}, "none of the images here: b.jpg.*x.jpg, y.jpg"),
        (
            {"pixels": PIXELS | {"b.jpg": [[1, 1], [150, 3]]}},
            r"a keypoint of b.jpg lies at \(150, 3\), outside .*100x80",
        ),
        ({"matches": [[0, 2]]}, "a match of a.jpg and b.jpg is of a keypoint that is not there; they have 3 and 2"),
        ({"columns": 3}, "keypoints of a.jpg have 3 numbers each, but must have 2, 4 or 6"),
        ({"matches": [[0, 1, 2]]}, "matches of a.jpg and b.jpg have 3 numbers each, but must have 2"),
        ({"pair": 2**31 + 6}, "of image 7, but no image of this number"),
        ({"matches": np.zeros((0, 2))}, "no matches of two of the images here"),
    ],
)
def test_what_is_wrong_with_a_database_is_said_in_a_sentence(tmp_path, changes, sentence):
    path = _write(tmp_path / "some.db", **changes)

    with pytest.raises(CaptureError, match=rf"some\.db.*{sentence}") as raised:
        read_correspondences(path, None, NAMES, SIZES)
    assert "\n" not in str(raised.value)


def test_a_file_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "some.db").write_bytes(b"nothing of the kind" * 100)
    (tmp_path / "some.txt").write_bytes(b"")

    for name, sentence in (("some.db", "not a whole COLMAP"), ("some.txt", "must be a COLMAP"), ("no.db", "no file")):
        with pytest.raises(CaptureError, match=f"{name} .*{sentence}"):
            read_correspondences(tmp_path / name, None, NAMES, SIZES)


@pytest.fixture
def hloc(tmp_path):
    """The folder of the two files of hloc, as h5py writes them."""
    h5py = pytest.importorskip("h5py", reason="needs torchrefrac[hloc]")
    with h5py.File(tmp_path / "features.h5", "w") as file:
        for name, places in PIXELS.items():
            file[f"left/{name}/keypoints"] = np.array(places) - 0.5
    partner = np.full(3, -1)
    partner[[2, 0]] = 0, 1
    with h5py.File(tmp_path / "matches.h5", "w") as file:
        file["left-a.jpg/left-b.jpg/matches0"] = partner
    return tmp_path


def test_files_of_hloc_are_read_half_a_pixel_further(hloc):
    names = tuple(f"left/{name}" for name in NAMES)

    found = read_correspondences(hloc / "features.h5", hloc / "matches.h5", names, SIZES)

    _require_right(found._replace(missing=[name.removeprefix("left/") for name in found.missing]))


def test_keypoints_of_hloc_without_matches_or_h5py_are_refused(hloc, monkeypatch):
    with pytest.raises(CaptureError, match=r"name the file of their matches as features\.matches"):
        read_correspondences(hloc / "features.h5", None, NAMES, SIZES)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(CaptureError, match=r"needs h5py, which is not installed: pip install torchrefrac\[hloc\]"):
        read_correspondences(hloc / "features.h5", hloc / "matches.h5", NAMES, SIZES)


def test_matches_are_whole_numbers(tmp_path):
    found = read_correspondences(_write(tmp_path / "database.db"), None, NAMES, SIZES)

    assert found.matches[0, 1].dtype == torch.long
