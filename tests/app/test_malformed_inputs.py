"""Inputs that are wrong by rule: every field times every kind of wrongness, every file cut, overwritten or replaced,
every option out of range, folders of all names. Each ends with one sentence and a failure, or with a right result, or
with a warning; and what was given stays."""

import json
import math
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh

from tests.app.malformed import OF_ANY, OF_FILES, OF_LISTS, OF_MEMBERS, spoil_field, spoil_file
from torchrefrac.config import AdjustOptions, Options
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.files.colmap.model import write_colmap
from torchrefrac.files.tracks import read_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.files.water import write_water
from torchrefrac.scene import Scene

COMMANDS = {
    "run": ("scene=capture", "scene.path=capture", "features.max_features=500"),
    "adjust": ("adjust", "alignment=run", "water.path=water.json", "survey=survey.json"),
    "adjust text": ("adjust", "alignment=text", "index_ratio=1.33"),
    "adjust binary": ("adjust", "alignment=binary", "index_ratio=1.33"),
    "densify": (
        "densify", "run=run", "dense=depthmap", "dense.cell=24", "outputs.mesh=false", "outputs.raster=false",
        "outputs.depth_maps=false",
    ),
}  # fmt: skip
LENS = """intrinsics intrinsics/width intrinsics/fx intrinsics/fy intrinsics/cx intrinsics/cy intrinsics/distortion[]"""
POSE = """images/0/cam_from_world_rotation[] images/0/cam_from_world_rotation/0[] images/0/cam_from_world_rotation/0/0
    images/0/center_in_world[] images/0/center_in_world/0"""
FIELDS = {
    "run: capture/capture.json": f"""{LENS} intrinsics/height intrinsics/distortion/0 format length_unit index_ratio
        pixel_origin down_in_cam_sigma_deg images[] images/1 images/1/name images/1/down_in_cam[] images/1/down_in_cam/1
        images/0/height images/1/heading_deg images/1/center_prior[] images/1/center_prior/0""",
    "run: capture/truth.json": f"""{POSE} format length_unit index_ratio surface planes[] planes/0 planes/0/origin[]
        planes/0/e1/0 images[] images/0 images/0/name""",
    "adjust: run/cameras.json": f"""{LENS} {POSE} format length_unit index_ratio pixel_origin images[] images/0
        images/0/name images/0/registered images/0/center_covariance[] images/0/center_covariance/0/0""",
    "adjust: survey.json": """format pixel_origin images images/cam00.jpg images/cam00.jpg/down_in_cam[]
        images/cam00.jpg/down_in_cam_sigma_deg images/cam00.jpg/height images/cam00.jpg/height_sigma
        images/cam00.jpg/center[] images/cam00.jpg/center/0 images/cam00.jpg/center_sigma
        images/cam02.jpg/center_covariance[] images/cam02.jpg/center_covariance/0/1 marks marks/A marks/A/position[]
        marks/A/position/0 marks/A/sigma marks/A/observations marks/A/observations/cam00.jpg[]
        marks/A/observations/cam00.jpg/0 marks/B/on_waterline marks/B/waterline_sigma scale_bars[] scale_bars/0
        scale_bars/0/from scale_bars/0/to scale_bars/0/length scale_bars/0/sigma""",
    "adjust: water.json": """format length_unit index_ratio planes[] planes/0 planes/0/normal[] planes/0/normal/2
        planes/0/offset plane_of plane_of/cam00.jpg""",
    "densify: run/metrics.json": "status stages[] model scene capture overrides length_unit",
}
"""The fields of files that are made wrong, behind the command that reads them; with [] those that are lists."""
FILES = {
    "run": """capture/capture.json capture/images/cam02.jpg capture/images/cam04.jpg capture/masks/cam02.jpg.png
        capture/truth.json capture/truth_points.npz capture/surface.ply""",
    "adjust": "run/cameras.json run/tracks.npz survey.json water.json",
    "adjust text": "text/cameras.txt text/images.txt text/points3D.txt",
    "adjust binary": "binary/cameras.bin binary/images.bin binary/points3D.bin",
    "densify": """run/metrics.json run/cameras.json run/tracks.npz capture/capture.json capture/images/cam02.jpg
        capture/masks/cam02.jpg.png""",
}
"""The files that a command reads."""
NAMES = (
    "Überflug_湖", "H=40m", "a (1)", "2024", "1e3", "null", "a b", " a ", "a\nb", "a,b", "[a]", "{a}", "it's", 'a"b',
    "$a", "${a}", "%s", "#a", "~a", "-a", "a" * 200,
)  # fmt: skip
"""Of folders."""
OUT_OF_RANGE = ("nan", "-inf", "-1000000", "1e300", "a")
EXACT_CM = 1.5
"""Error of the cameras of a result that counts as right: photographs of 320 x 240 pixels."""
SECONDS = 5.0
"""What a command may compute without a word."""
LONGEST_LINE = 1000


SAID = ("warnings", "not_registered", "lost_images", "lost_marks", "images_only_in_survey")
"""Metrics that name what is wrong with a result."""


@dataclass(frozen=True)
class Case:
    """The command; how what it is given is changed; more arguments; the folder of the results."""

    command: str
    change: Callable[[Path], None] = lambda folder: None
    arguments: tuple[str, ...] = ()
    out: str = "new"

    @property
    def all_arguments(self) -> tuple[str, ...]:
        out = () if self.command == "densify" else (f"out={self.out}",)
        return (*COMMANDS[self.command], *self.arguments, *out)


def _cases() -> Iterator[tuple[str, Case]]:
    for where, names in FIELDS.items():
        command, file = where.split(": ")
        for name in names.split():
            field = name.removesuffix("[]")
            kinds = (*OF_ANY, *(OF_LISTS if field != name else ()), *(() if field[-1].isdigit() else OF_MEMBERS))
            for kind in kinds:
                yield f"{where}: {field} is {kind}", Case(command, partial(_in_field, file, field, kind))
    for command, files in FILES.items():
        for file in files.split():
            for kind in OF_FILES:
                yield f"{command}: {file} is {kind}", Case(command, partial(_in_file, file, kind))
    for command, options in (("run", Options()), ("adjust", AdjustOptions(alignment="run", out="new"))):
        for option in _numbers("", options):
            for value in OUT_OF_RANGE:
                yield f"{command}: {option} is {value}", Case(command, arguments=(f"{option}={value}",))
    for name in NAMES:
        yield f"run: folder {name!r}", Case("run", partial(_renamed, name), (f"scene.path={name}",), f"{name}_")


def _in_field(file: str, field: str, kind: str, folder: Path) -> None:
    spoil_field(folder / file, field, kind)


def _in_file(file: str, kind: str, folder: Path) -> None:
    spoil_file(folder / file, kind)


def _renamed(name: str, folder: Path) -> None:
    (folder / "capture").rename(folder / name)


def _numbers(prefix: str, options: Any) -> Iterator[str]:
    """Names of the options that are numbers."""
    for field in fields(options):
        value, name = getattr(options, field.name), f"{prefix}{field.name}"
        if is_dataclass(value):
            yield from _numbers(f"{name}.", value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield name


ALL = dict(_cases())
FAST, MANY = list(ALL)[::149], list(ALL)[::2]
"""Some of them: the kinds of wrongness of a field are odd in number, so that every other one takes turns."""


@pytest.fixture(scope="session")
def inputs(made_once, sparse):
    """Folder with all that the commands are given, nothing wrong with it. Not to be changed."""
    return made_once("inputs", lambda folder: _make_inputs(sparse, folder))


def _make_inputs(sparse: Path, folder: Path) -> None:
    for name in ("capture", "run"):
        shutil.copytree(sparse / name, folder / name)
    capture, run = folder / "capture", folder / "run"
    content = json.loads((capture / "capture.json").read_text())
    for image in content["images"]:
        image |= {"heading_deg": 10.0, "center_prior": [0.0, 0.0, 30.0]}
    (capture / "capture.json").write_text(json.dumps(content))
    (capture / "masks").mkdir()
    cv2.imwrite(str(capture / "masks" / "cam02.jpg.png"), np.pad(np.full((232, 312), 255, np.uint8), 4))
    truth = json.loads((capture / "truth.json").read_text())
    (capture / "truth.json").write_text(json.dumps(truth | {"surface": "surface.ply", "index_ratio": 1.33}))
    trimesh.Trimesh([[-99, -99, -99], [99, -99, -99], [0, 99, -99]], [[0, 1, 2]]).export(capture / "surface.ply")
    shown = np.full((len(truth["images"]), 6, 8, 3), np.nan, np.float32)
    np.savez(capture / "truth_points.npz", X=shown, plane=np.zeros(shown.shape[:3], int), step=40, offset=2.0)
    told = {"scene": "capture", "capture": "capture", "overrides": {"seed": "0"}, "length_unit": "cm"}
    (run / "metrics.json").write_text(json.dumps(json.loads((run / "metrics.json").read_text()) | told))
    scene = read_scene(run)
    write_water(scene, folder / "water.json")
    water = json.loads((folder / "water.json").read_text())
    (folder / "water.json").write_text(json.dumps(water | {"plane_of": dict.fromkeys(scene.views.names, 0)}))
    write_colmap(scene, folder / "text")
    write_colmap(scene, folder / "binary", binary=True)
    (folder / "survey.json").write_text(json.dumps(_survey(scene)))


def _survey(scene: Scene) -> dict[str, Any]:
    """What could have been measured of a reconstruction."""
    place = dict(zip(scene.views.names, scene.views.center.tolist(), strict=True))
    down = dict(zip(scene.views.names, (-scene.views.rotation[:, :, 2]).tolist(), strict=True))
    variance = torch.eye(3, dtype=torch.float64).mul(0.04).tolist()
    seen = scene.observations
    a, b = torch.bincount(seen.point).argsort(descending=True, stable=True)[:2].tolist()
    observed = {
        name: {scene.views.names[int(v)]: xy.tolist() for v, xy in zip(seen.view[rows], seen.pixels[rows], strict=True)}
        for name, rows in (("A", seen.point == a), ("B", seen.point == b))
    }
    first, second, third = scene.views.names
    return {
        "format": "torchrefrac-survey/1",
        "pixel_origin": "corner",
        "images": {
            first: {"down_in_cam": down[first], "down_in_cam_sigma_deg": 0.5, "height": place[first][2]}
            | {"height_sigma": 0.2, "center": place[first], "center_sigma": 0.2},
            second: {"center": place[second], "center_covariance": variance},
            third: {"center": place[third], "center_sigma": [0.2, 0.2, 0.2]},
        },
        "marks": {
            "A": {"observations": observed["A"], "position": scene.points[a].tolist(), "sigma": 0.2},
            "B": {"observations": observed["B"], "on_waterline": False, "waterline_sigma": 0.2},
        },
        "scale_bars": [
            {"from": "A", "to": "B", "length": float((scene.points[a] - scene.points[b]).norm()), "sigma": 0.2}
        ],
    }


def _content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _refused_number(text: str) -> None:
    raise AssertionError(f"metrics.json holds {text}, which is no JSON")


def _judge(case, inputs, torchrefrac, folder):
    for name in inputs.iterdir():
        copy = shutil.copytree if name.is_dir() else shutil.copy
        copy(name, folder / name.name)
    case.change(folder)
    before, start = _content(folder), time.process_time()

    ended = torchrefrac(*case.all_arguments)

    seconds, after = time.process_time() - start, _content(folder)
    assert "Traceback" not in ended.out + ended.err
    assert max(map(len, ended.err.splitlines()), default=0) < LONGEST_LINE
    assert seconds < SECONDS or " in " in ended.err, "it computed without a word"
    own = {path for path in before if case.command == "densify" and folder / "run" in path.parents}
    assert {path: content for path, content in after.items() if path in before and path not in own} == {
        path: content for path, content in before.items() if path not in own
    }
    assert own <= set(after)
    if ended.status:
        assert len([line for line in ended.err.splitlines() if "error: " in line]) == 1, ended.err
        return
    out = folder / ("run" if case.command == "densify" else case.out)
    found = json.loads((out / "metrics.json").read_text(), parse_constant=_refused_number)
    scene = read_scene(out if (out / "cameras.json").is_file() else out / "colmap")
    error = evaluate(scene, load_truth(inputs / "capture"))[0].get("camera_rms_cm", math.inf)
    assert error < EXACT_CM or any(found.get(name) for name in SAID), found


@pytest.mark.parametrize("name", FAST)
def test_what_is_malformed_is_named_or_survived(name, inputs, torchrefrac, tmp_path):
    _judge(ALL[name], inputs, torchrefrac, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", MANY)
def test_much_that_is_malformed_is_named_or_survived(name, inputs, torchrefrac, tmp_path):
    _judge(ALL[name], inputs, torchrefrac, tmp_path)


@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_not_malformed_is_right(command, inputs, torchrefrac, tmp_path):
    _judge(Case(command), inputs, torchrefrac, tmp_path)
