"""Parts of work that lie in files once they are done."""

from pathlib import Path

import numpy as np
import pytest

from tests.worker_jobs import row_of
from torchrefrac.files.work import Form, Work

FORM = Form({"values": "f:n"}, mapped=("large",))


class Counting:
    """Does what `row_of` does, and counts."""

    def __init__(self):
        self.done = []

    def __call__(self, number):
        self.done.append(number)
        return row_of(number)


@pytest.fixture
def done():
    return Counting()


def _all(work, function, made_from=("x", 1), numbers=range(5)):
    return dict(work.parts("rows", made_from, function, numbers, FORM, 1.0))


def test_parts_are_done_once_and_read_afterwards(tmp_path, done):
    work = Work(folder=tmp_path / "work")
    first = _all(work, done)
    second = _all(work, done)

    assert done.done == [0, 1, 2, 3, 4]
    for number in range(5):
        for name in ("values", "large"):
            assert np.array_equal(first[number][name], second[number][name])
    assert isinstance(first[3]["large"], np.memmap)


def test_another_input_and_damaged_or_missing_parts_are_done_again(tmp_path, done):
    work = Work(folder=tmp_path / "work")
    _all(work, done)
    (place,) = (tmp_path / "work").iterdir()
    done.done.clear()

    _all(work, done, made_from=("x", 2))
    assert done.done == [0, 1, 2, 3, 4]
    done.done.clear()
    (place / "part_000001.npz").write_bytes(b"half")
    (place / "part_000002.large.npy").unlink()
    (place / "part_000004.npz").unlink()
    found = _all(work, done)

    assert sorted(done.done) == [1, 2, 4]
    assert np.array_equal(found[4]["large"], np.full((4, 2), 4))


def test_clearing_removes_parts_alone(tmp_path, done):
    work = Work(folder=tmp_path / "work")
    _all(work, done)
    other = tmp_path / "work" / "notes.txt"
    other.write_text("mine", encoding="utf-8")
    work.clear()

    assert [path for path in (tmp_path / "work").rglob("*") if path.is_file()] == [other]
    other.unlink()
    _all(work, done)
    (place,) = (tmp_path / "work").iterdir()
    (place / ".part_000007.123.partial.npz").touch()  # of a process that was killed while it wrote
    work.clear()
    assert not (tmp_path / "work").exists()


def test_without_a_folder_nothing_is_written(tmp_path, done, monkeypatch):
    monkeypatch.chdir(tmp_path)

    assert len(_all(Work(), done)) == 5
    assert not list(Path().iterdir())
