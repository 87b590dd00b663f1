"""Finished images come back as they were, and only where nothing has changed."""

import os
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from tests.dense.planted_patches import patches_shown
from tests.dense.rendered_captures import sparse_scene, write_capture, write_mask
from tests.dense.rendered_scenes import Board, cameras_around, marble, render
from torchrefrac.dense import DenseOptions, FolderStore, SweepOptions, densify
from torchrefrac.dense.patches import Patches
from torchrefrac.dense.store import NoStore, fingerprint
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Interfaces

OPTIONS = DenseOptions(method="patch", cell=5)


@pytest.fixture(scope="module")
def pond():
    """Two photographs of a flat bottom."""
    return render([Board((0.0, 0.0, -40.0))], cameras_around(2, 30.0, -30.0, 1.33), marble(), 1.33)


@pytest.fixture
def capture(pond, tmp_path):
    return write_capture(pond, tmp_path / "capture")


@pytest.fixture
def scene(pond, capture):
    return replace(sparse_scene(pond), capture=capture)


@pytest.fixture
def patches(pond):
    return patches_shown(pond, 5, (0,)).padded(OPTIONS.views)


@pytest.fixture
def open_store(tmp_path, capture, scene):
    """`open_store()`: the same folder again, by default for the same work."""

    def make(**other):
        made_from = {"scene": scene, "options": OPTIONS} | other
        return FolderStore(tmp_path / "parts", **made_from)

    return make


def _assert_same(first, second):
    assert len(first) == len(second)
    for field in fields(Patches):
        a, b = getattr(first, field.name), getattr(second, field.name)
        assert a.dtype == b.dtype, field.name
        assert torch.equal(a, b), field.name


@pytest.mark.parametrize("rows", [slice(None), slice(0, 0)])
def test_what_is_saved_comes_back_bit_by_bit(open_store, patches, rows):
    some = patches[torch.arange(len(patches))[rows]]
    open_store().save(1, some)

    _assert_same(open_store().load(1), some)


def test_what_was_never_saved_is_not_there(open_store, patches):
    store = open_store()
    store.save(1, patches)

    assert store.load(0) is None
    assert store.load(10) is None


def test_saving_again_replaces(open_store, patches):
    store = open_store()
    store.save(0, patches)
    store.save(0, patches[torch.arange(3)])

    assert len(store.load(0)) == 3


@pytest.mark.parametrize("harm", ["truncated", "flipped", "empty", "text", "another archive"])
def test_a_damaged_part_is_not_there_and_can_be_saved_again(open_store, patches, harm):
    store = open_store()
    store.save(0, patches)
    path = store.folder / "patches_00000.npz"
    whole = path.read_bytes()
    half = len(whole) // 2
    flipped = whole[:half] + bytes([whole[half] ^ 0xFF]) + whole[half + 1 :]
    np.savez(store.folder / "other.npz", reference=np.zeros(3))
    other = (store.folder / "other.npz").read_bytes()
    harmed = {"truncated": whole[:half], "flipped": flipped, "empty": b"", "text": b"patches", "another archive": other}
    path.write_bytes(harmed[harm])

    assert open_store().load(0) is None
    store.save(0, patches)
    _assert_same(open_store().load(0), patches)


def test_a_damaged_label_clears_the_folder(open_store, patches):
    store = open_store()
    store.save(0, patches)
    (store.folder / "made_from.txt").write_bytes(b"\xff\xfe")

    assert open_store().load(0) is None


@pytest.mark.parametrize("change", ["options", "sweep", "pose", "points", "water", "level", "registered"])
def test_other_work_clears_the_folder(open_store, patches, scene, change):
    open_store().save(0, patches)
    views = scene.views
    other = {
        "options": {"options": replace(OPTIONS, min_score=0.7)},
        "sweep": {"options": replace(OPTIONS, sweep=SweepOptions(planes=50))},
        "pose": {"scene": replace(scene, views=replace(views, pose=Rigid(views.rotation, views.center + 1e-9)))},
        "points": {"scene": replace(scene, points=scene.points.flip(0))},
        "water": {"scene": replace(scene, interfaces=Interfaces.level(1.34))},
        "level": {"scene": replace(scene, interfaces=Interfaces.level(1.33, 1e-9))},
        "registered": {"scene": replace(scene, views=replace(views, registered=torch.tensor([True, False])))},
    }

    assert open_store(**other[change]).load(0) is None
    assert open_store().load(0) is None


def test_a_photograph_that_is_written_again_clears_the_folder(open_store, patches, capture):
    open_store().save(0, patches)
    stat = capture.paths[1].stat()
    os.utime(capture.paths[1], ns=(stat.st_atime_ns, stat.st_mtime_ns + 1000))

    assert open_store().load(0) is None


def test_a_new_mask_clears_the_folder(open_store, patches, capture):
    open_store().save(0, patches)
    write_mask(capture, "0.png", torch.ones(120, 160, dtype=torch.bool))

    assert open_store().load(0) is None


def test_the_fingerprint_is_the_same_for_the_same_work(capture, scene):
    again = replace(scene, points=scene.points.clone())

    assert fingerprint(scene, OPTIONS) == fingerprint(again, replace(OPTIONS))


def test_clearing_removes_its_own_files_only(open_store, patches):
    store = open_store()
    store.save(0, patches)
    foreign = store.folder / "notes.txt"
    foreign.write_text("mine")

    store.clear()
    left = [path.name for path in store.folder.iterdir()]
    foreign.unlink()
    store.clear()

    assert left == ["notes.txt"]
    assert not store.folder.exists()
    store.clear()


def test_no_store_keeps_nothing(patches):
    store = NoStore()
    store.save(0, patches)

    assert store.load(0) is None


def test_room_is_no_file_that_anyone_sees(open_store, patches):
    store = open_store()
    room = store.room(len(patches) + 2, OPTIONS.views)
    room.put(2, patches)

    patches = replace(patches, pixels=patches.pixels.double())
    _assert_same(room[torch.arange(2, len(room))], patches)
    assert not room.points[:2].any()
    assert [path.name for path in store.folder.iterdir()] == ["made_from.txt"]
    store.clear()
    _assert_same(room[torch.arange(2, len(room))], patches)


def test_room_for_none_is_empty(open_store):
    assert len(open_store().room(0, OPTIONS.views)) == 0


class PowerError(Exception):
    """The power fails."""


class _Interrupting:
    """Fails when the second image has been finished, before it is kept."""

    def __init__(self, store):
        self.store, self.saved = store, 0

    def load(self, image):
        return self.store.load(image)

    def save(self, image, patches):
        if self.saved == 1:
            raise PowerError
        self.saved += 1
        self.store.save(image, patches)

    def room(self, count, views):
        return self.store.room(count, views)


@pytest.mark.parametrize("method", ["patch", "depthmap"])
def test_an_interrupted_run_ends_as_one_that_was_not(open_store, capture, scene, method):
    options = replace(OPTIONS, method=method)
    whole = densify(replace(scene, capture=capture), options)

    with pytest.raises(PowerError):
        densify(replace(scene, capture=capture), options, store=_Interrupting(open_store(options=options)))
    kept = [image for image in (0, 1) if open_store(options=options).load(image) is not None]
    resumed = densify(replace(scene, capture=capture), options, store=open_store(options=options))

    assert len(kept) == 1
    assert len(whole.patches) > 300
    _assert_same(resumed.patches, whole.patches)
    for field in fields(whole.cloud):
        a, b = getattr(resumed.cloud, field.name), getattr(whole.cloud, field.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def test_finished_images_are_not_looked_at_again(open_store, capture, scene, patches):
    """Both images are there with what was planted: that is what comes out."""
    planted = {0: patches[torch.arange(0, len(patches), 2)], 1: patches[torch.arange(1, len(patches), 2)]}
    for image, part in planted.items():
        open_store().save(image, part)

    found = densify(replace(scene, capture=capture), OPTIONS, store=open_store()).patches

    assert len(found) > 0.99 * len(patches)
    assert set(found.pixels[:, 0].tolist()) <= set(patches.pixels[:, 0].tolist())
    assert (found.sigma == patches.sigma[0]).all()
