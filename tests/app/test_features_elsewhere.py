"""Reconstructions from keypoints of another program's file, of a network, and of one's own extractor."""

import sqlite3
from contextlib import closing
from dataclasses import dataclass, replace

import cv2
import pytest
import torch
from kornia.feature import DISK

import torchrefrac as tr
from torchrefrac.cli.arguments import for_hydra
from torchrefrac.commands.pairs import choose_pairs
from torchrefrac.commands.photographs import extract, made_elsewhere, match_pairs
from torchrefrac.config import OptionError, Options, build
from torchrefrac.features import MadeElsewhereOptions, NetworkOptions, SiftOptions, extract_sift
from torchrefrac.files.work import Work
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import CaptureError

OURS = Options(features=SiftOptions(max_features=800))


@dataclass(frozen=True)
class Own:
    """An extractor as users write them."""

    most: int

    def __call__(self, path, used=None):
        found = extract_sift(path, SiftOptions(max_features=self.most), used)
        return replace(found, descriptors=found.unit())


def _write_database(path, capture, features, matches):
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
        database.execute("CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        database.execute("CREATE TABLE matches (pair_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        for image, (name, found) in enumerate(zip(capture.names, features, strict=True), start=1):
            blob = found.pixels.float().numpy().tobytes()
            database.execute("INSERT INTO images VALUES (?, ?)", (image, name))
            database.execute("INSERT INTO keypoints VALUES (?, ?, 2, ?)", (image, len(found), blob))
        for pair in matches:
            number = (pair.first + 1) * (2**31 - 1) + pair.second + 1
            blob = pair.matches.to(torch.uint32).numpy().tobytes()
            database.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", (number, len(pair), blob))
        database.commit()


@pytest.fixture
def tank(part_of_tank):
    return tr.load_capture(part_of_tank(range(4)))


@pytest.fixture
def database(tank, tmp_path):
    """Our own keypoints and matches, as COLMAP would keep them."""
    features = extract(tank, OURS, SilentRecorder())
    matches = match_pairs(features, choose_pairs(tank, features, OURS.matching, 0), OURS.matching, SilentRecorder())
    _write_database(tmp_path / "database.db", tank, features, matches)
    return tmp_path / "database.db", features, matches


def test_cameras_from_a_database_are_those_from_our_own_keypoints(tank, database):
    ours = tr.reconstruct(tank, OURS)

    scene = tr.reconstruct(tank, Options(features=MadeElsewhereOptions(str(database[0]))))

    assert bool(scene.views.registered.all())
    away = scene.views.center - ours.views.center
    assert float(away.norm(dim=-1).max()) < 0.1  # cm; without descriptors no tracks are completed


def test_matches_of_a_database_are_those_of_our_own(tank, database):
    path, features, matches = database

    read, pairs = made_elsewhere(tank, MadeElsewhereOptions(str(path)), SilentRecorder())

    for ours, found in zip(features, read, strict=True):
        assert torch.allclose(found.pixels, ours.pixels, atol=1e-4)
        assert torch.equal(found.colors, ours.colors)
    assert [(pair.first, pair.second) for pair in pairs] == [(pair.first, pair.second) for pair in matches]
    assert all(torch.equal(one.matches, other.matches) for one, other in zip(pairs, matches, strict=True))


def test_what_a_mask_hides_is_not_taken_from_a_file(tank, database):
    hidden = torch.full((480, 640), 255, dtype=torch.uint8).numpy()
    hidden[:, :320] = 0
    (tank.folder / "masks").mkdir()
    cv2.imwrite(str(tank.folder / "masks" / f"{tank.names[0]}.png"), hidden)

    read, pairs = made_elsewhere(tank, MadeElsewhereOptions(str(database[0])), SilentRecorder())

    assert 0 < len(read[0]) < len(database[1][0])
    assert float(read[0].pixels[:, 0].min()) >= 320.0
    before = database[2][0].matches
    right = database[1][0].pixels[before[:, 0], 0] >= 320.0
    assert torch.allclose(read[0].pixels[pairs[0].matches[:, 0]], database[1][0].pixels[before[right, 0]], atol=1e-4)
    assert torch.equal(pairs[0].matches[:, 1], before[right, 1])


def test_images_that_a_file_lacks_are_named(tank, database):
    with closing(sqlite3.connect(database[0])) as changed:
        changed.execute("DELETE FROM keypoints WHERE image_id = 4")
        changed.execute("DELETE FROM matches WHERE pair_id % 2147483647 = 4")
        changed.commit()
    notes = []

    class Noting(SilentRecorder):
        def note(self, text):
            notes.append(text)

    read, _ = made_elsewhere(tank, MadeElsewhereOptions(str(database[0])), Noting())

    assert len(read[3]) == 0
    assert notes == [f"{database[0]} has no keypoints of 1 images, which remain out: {tank.names[3]}"]


def test_a_file_that_is_missing_is_named(tank):
    with pytest.raises(CaptureError, match=r"none\.db is no file"):
        tr.reconstruct(tank, Options(features=MadeElsewhereOptions("none.db")))


def test_an_extractor_of_ones_own_takes_the_place_of_ours(tank):
    scene = tr.reconstruct(tank, Options(features=Own(800)))

    assert bool(scene.views.registered.all())


def test_keypoints_that_lie_in_a_folder_are_made_again_with_other_weights(tank, tmp_path):
    one, path = tank.of_views([0]), tmp_path / "weights.pth"
    path.touch()
    options = Options(features=NetworkOptions(weights=str(path), max_features=20, max_pixels=1e4), device="cpu")
    work, found = Work(folder=tmp_path / "work"), []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        torch.save(DISK().state_dict(), path)
        found.append(extract(one, options, SilentRecorder(), work)[0])

    assert torch.equal(found[0].pixels, found[1].pixels)
    assert not torch.equal(found[0].descriptors, found[2].descriptors)
    assert len(list((tmp_path / "work").iterdir())) == 2


def test_a_method_is_named_in_the_options():
    assert build(Options, {"features": {"max_features": 9}}).features == SiftOptions(max_features=9)
    aliked = {"method": "kornia_aliked", "max_features": 9}
    assert build(Options, {"features": aliked}).features == NetworkOptions("kornia_aliked", max_features=9)
    with pytest.raises(
        OptionError, match=r"features\.method is 'orb', but must be one of sift, kornia_disk, kornia_al"
    ):
        build(Options, {"features": {"method": "orb"}})
    with pytest.raises(OptionError, match="features is 3, but must be a group of options"):
        build(Options, {"features": 3})


def test_a_file_is_a_choice_of_features_by_itself():
    assert for_hydra(["features=a/b.db"]) == ["features=file", "features.path=a/b.db"]
    assert for_hydra(["features=kornia_disk"]) == ["features=kornia_disk"]
