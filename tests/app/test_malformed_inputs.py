"""Inputs that are wrong by rule: every field times every kind of wrongness, every file cut or overwritten, every option
out of range. Each ends with one sentence and a failure, or with a right result, or with a warning."""

import json
import math
import random
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from torchrefrac.config import Options

WRONG = {
    "missing": None, "null": None, "text": "a", "empty": "", "list": [], "object": {}, "yes": True, "nan": math.nan,
    "infinite": math.inf, "negative": -1, "zero": 0, "huge": 1e308, "tiny": 1e-308, "long": 10**400,
}  # fmt: skip
FIELDS = (
    "format", "length_unit", "index_ratio", "pixel_origin", "intrinsics", "intrinsics.width", "intrinsics.height",
    "intrinsics.fx", "intrinsics.fy", "intrinsics.cx", "intrinsics.cy", "intrinsics.distortion",
    "intrinsics.distortion.0", "down_in_cam_sigma_deg", "images", "images.1", "images.1.name", "images.1.down_in_cam",
    "images.1.down_in_cam.1", "images.0.height",
)  # fmt: skip
SHARES = (0.0, 0.02, 0.5, 0.9)
OUT_OF_RANGE = ("nan", "-inf", "-1000000", "1e300")
EXACT_CM = 1.5
"""Error of the cameras of a result that counts as right: photographs of 320 x 240 pixels."""


@dataclass(frozen=True)
class Case:
    """name; how the capture is changed; more arguments of the command."""

    name: str
    change: Any = None
    arguments: tuple[str, ...] = ()


def _cases() -> Iterator[Case]:
    for field in FIELDS:
        for kind in WRONG:
            yield Case(f"{field} is {kind}", lambda folder, field=field, kind=kind: _spoil(folder, field, kind))
    for file in ("capture.json", "images/cam02.jpg", "images/cam04.jpg"):
        for share in SHARES:
            yield Case(f"{file} ends at {share}", lambda folder, file=file, share=share: _cut(folder / file, share))
            yield Case(
                f"{file} is noise from {share} on", lambda folder, file=file, share=share: _noise(folder / file, share)
            )
    for option in _numbers("", Options()):
        for value in OUT_OF_RANGE:
            yield Case(f"{option}={value}", arguments=(f"{option}={value}",))


def _numbers(prefix: str, options: Any) -> Iterator[str]:
    """Names of the options of a reconstruction that are numbers."""
    for field in fields(options):
        value, name = getattr(options, field.name), f"{prefix}{field.name}"
        if is_dataclass(value):
            yield from _numbers(f"{name}.", value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield name


def _spoil(folder: Path, field: str, kind: str) -> None:
    path = folder / "capture.json"
    content = json.loads(path.read_text())
    *way, last = [int(part) if part.isdigit() else part for part in field.split(".")]
    place = content
    for part in way:
        place = place[part]
    if kind == "missing":
        del place[last]
    else:
        place[last] = WRONG[kind]
    path.write_text(json.dumps(content))


def _cut(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


def _noise(path: Path, share: float) -> None:
    content = bytearray(path.read_bytes())
    start = int(share * len(content))
    content[start:] = random.Random(1).randbytes(len(content) - start)
    path.write_bytes(bytes(content))


ALL = list(_cases())
FAST = ALL[::37]


def _judge(case, sparse, torchrefrac, metrics, tmp_path):
    capture, run = tmp_path / "capture", tmp_path / "run"
    shutil.copytree(sparse / "capture", capture)
    if case.change is not None:
        case.change(capture)
    before = {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()}

    ended = torchrefrac("scene=capture", "scene.path=capture", "features.max_features=500", *case.arguments, "out=run")

    assert {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()} == before
    assert "Traceback" not in ended.out + ended.err
    if ended.status:
        errors = [line for line in ended.err.splitlines() if "error: " in line]
        assert len(errors) == 1, ended.err
        return
    found = metrics(run)
    assert found["warnings"] or found.get("not_registered") or found.get("camera_rms_cm", math.inf) < EXACT_CM, found


@pytest.mark.parametrize("case", FAST, ids=lambda case: case.name)
def test_what_is_malformed_is_named_or_survived(case, sparse, torchrefrac, metrics, tmp_path):
    _judge(case, sparse, torchrefrac, metrics, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("case", ALL, ids=lambda case: case.name)
def test_all_that_is_malformed_is_named_or_survived(case, sparse, torchrefrac, metrics, tmp_path):
    _judge(case, sparse, torchrefrac, metrics, tmp_path)
