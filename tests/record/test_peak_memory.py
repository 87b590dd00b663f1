"""Peak memory of a stretch of work."""

import sys

import pytest
import torch

from torchrefrac.record import memory

BIG = 200 << 20  # bytes


def test_memory_that_was_needed_and_freed_counts_until_it_is_forgotten():
    if not memory.CLEAR.exists():
        pytest.skip("this system does not forget a peak of memory")
    memory.forget_peak_memory()
    before = memory.peak_memory_gib()

    torch.ones(BIG, dtype=torch.uint8)  # and gone again
    with_it = memory.peak_memory_gib()
    memory.forget_peak_memory()
    after = memory.peak_memory_gib()

    assert before is not None
    assert with_it is not None
    assert after is not None
    assert with_it - before > 0.9 * BIG / memory.GIB
    assert after < with_it - 0.5 * BIG / memory.GIB


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not say it this way")
def test_where_nothing_can_be_forgotten_the_peak_is_that_of_the_process(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "CLEAR", tmp_path / "missing" / "clear_refs")
    monkeypatch.setattr(memory, "STATUS", tmp_path / "status")

    memory.forget_peak_memory()

    known = memory.peak_memory_gib()
    assert known is not None
    assert 0.01 < known < 1000.0
