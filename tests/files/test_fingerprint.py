"""Fingerprints are those of what things are, and of all of it."""

import os
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from torchrefrac.files.fingerprint import fingerprint_of


@dataclass(frozen=True)
class Pair:
    name: str
    values: object


def _things(path):
    return [
        1, 1.0, True, None, "1", b"1", (1, 2), (1, (2,)), ((1,), 2), {"a": 1}, {"a": 2}, {"b": 1}, frozenset({3}),
        torch.zeros(2), torch.zeros(2).double(), torch.zeros(1, 2), torch.ones(2), Pair("a", 1), Pair("b", 1),
        Pair("a", torch.ones(1)), path, (), ("a", "bc"), ("ab", "c"),
    ]  # fmt: skip


def test_different_things_have_different_fingerprints_and_equal_ones_the_same(tmp_path):
    found = [fingerprint_of(thing) for thing in _things(tmp_path / "x")]

    assert len(set(found)) == len(found)
    assert found == [fingerprint_of(thing) for thing in _things(tmp_path / "x")]
    assert fingerprint_of({"a": 1, "b": 2}) == fingerprint_of({"b": 2, "a": 1})
    assert fingerprint_of(torch.arange(6).view(2, 3).T) == fingerprint_of(torch.arange(6).view(2, 3).T.contiguous())


def test_a_file_that_has_changed_is_another(tmp_path):
    path = tmp_path / "x"
    path.write_text("one", encoding="utf-8")
    before = fingerprint_of(path)
    os.utime(path, ns=(0, 0))

    assert fingerprint_of(path) != before


def test_what_has_no_fingerprint_is_refused():
    with pytest.raises(ValueError, match="a function has no fingerprint"):
        fingerprint_of(np.float64(1.0), test_what_has_no_fingerprint_is_refused)
