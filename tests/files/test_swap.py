"""Results take the place of others as a whole, also where the process is killed between any two steps."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torchrefrac.files.swap import LOCK, PARTIAL, FolderInUseError, alone, finish, home, settle, swap

OLD = {"metrics.json": "old", "points.ply": "old", "dense.ply": "old", "dense/deep/a_depth.npz": "old"}
NEW = {"metrics.json": "new", "points.ply": "new", "water.json": "new", "colmap/cameras.txt": "new"}
MINE = {"notes.txt": "mine", "dense/notes.txt": "mine"}
STEPS = 12
KILLED = """
import os, pathlib, shutil, signal, sys
from pathlib import Path
from torchrefrac.files import swap
left = int(sys.argv[2])
def counted(step):
    def do(*arguments, **how):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(*arguments, **how)
    return do
os.replace, shutil.rmtree = counted(os.replace), counted(shutil.rmtree)
for name in ("unlink", "rename", "rmdir", "mkdir"):
    setattr(Path, name, counted(getattr(Path, name)))
folder = Path(sys.argv[1])
swap.swap(folder / swap.PARTIAL, sys.argv[3:])
"""


def _write(folder, content):
    for name, text in content.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def _read(folder):
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def folder(tmp_path):
    """Earlier results, what else lies there, and new results that are complete."""
    _write(tmp_path, OLD | MINE)
    _write(tmp_path / PARTIAL, NEW)
    return tmp_path


def test_new_results_take_the_place_of_the_old_ones_and_nothing_else_changes(folder):
    swap(folder / PARTIAL, OLD)

    assert _read(folder) == NEW | MINE
    assert not (folder / "dense" / "deep").exists()
    assert {path.name for path in folder.iterdir()} == {name.split("/")[0] for name in NEW | MINE}


def test_killed_at_any_step_the_old_or_the_new_results_are_there_whole(folder, tmp_path_factory):
    """Each step in a process of its own, all at once."""
    places = [tmp_path_factory.mktemp("killed") for _ in range(STEPS)]
    running = []
    for steps, place in enumerate(places):
        _write(place, OLD | MINE)
        _write(place / PARTIAL, NEW)
        command = [sys.executable, "-c", KILLED, str(place), str(steps), *OLD]
        running.append(subprocess.Popen(command, cwd=Path(__file__).parents[2]))
    statuses = [each.wait() for each in running]

    found = []
    for place in places:
        settle(place)
        new = {name: text for name, text in _read(place).items() if not name.startswith(PARTIAL)}
        assert new in (OLD | MINE, NEW | MINE)
        found.append(new == NEW | MINE)
    assert statuses[0] == statuses[5] == -signal.SIGKILL
    assert found[0] is False
    assert found[5] is True


def test_whoever_works_there_is_alone(tmp_path):
    sentence = "is in use by another process; wait until"
    with alone(tmp_path), pytest.raises(FolderInUseError, match=sentence), alone(tmp_path):
        pass
    with alone(tmp_path):
        assert (tmp_path / LOCK).is_file()
    assert not list(tmp_path.iterdir())


def test_a_reader_leaves_a_swap_to_the_process_that_does_it(folder):
    (folder / PARTIAL / "left_out.json").write_text('["dense.ply"]')
    (folder / PARTIAL).rename(folder / ".torchrefrac-ready")

    with alone(folder):
        settle(folder)
        assert (folder / "points.ply").read_text() == "old"
        finish(folder)
    assert (folder / "points.ply").read_text() == "new"
    assert not (folder / "dense.ply").exists()


def test_new_results_have_the_folder_around_them_as_home(tmp_path):
    assert home(tmp_path / PARTIAL) == home(tmp_path) == tmp_path
