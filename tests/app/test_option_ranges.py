"""No number that makes no sense gets through: every option, tried with what is never meant."""

import dataclasses
import math
import types
from typing import Union, get_args, get_origin, get_type_hints

import pytest

from torchrefrac.bundle import BundleOptions
from torchrefrac.config import AdjustOptions, DensifyOptions, OptionError, Options, OutputOptions, build, build_scene
from torchrefrac.config.clouds import CorrectOptions, TriangulateOptions
from torchrefrac.config.importing import CalibrateOptions, ImportOptions
from torchrefrac.synthetic.scenes import SCENES

NONSENSE = (math.nan, math.inf, -1, 10**12, -(10**400))
ALLOWED = {("plane.offset", -1), ("plane.normal", -1), ("plane.normal", 10**12), ("bundle.solver.max_damping", 10**12)}
ALLOWED |= {("sfm." + name, value) for name, value in ALLOWED}
ALLOWED |= {("water.level", -1), ("water_level", -1), ("take_off_above_water", -1)}
ALLOWED |= {("seed", 10**12), ("inertial.gravity_bias_deg", -1), ("plane_tilt_deg", -1), ("camera.distortion", -1)}
ALLOWED |= {("interface.tilt_deg", -1)}
REQUIRED = {
    Options: {},
    AdjustOptions: {"alignment": "a", "out": "b"},
    DensifyOptions: {"run": "a"},
    ImportOptions: {"photos": "a", "out": "b"},
    CorrectOptions: {"cloud": "a", "cameras": "b", "out": "c"},
    TriangulateOptions: {"run": "a", "tracks": "b"},
    CalibrateOptions: {"photos": "a", "out": "b", "columns": 9, "rows": 6, "square": 30.0},
    **{scene: {"name": "a"} for scene in SCENES.values()},
}


def _numbers(cls, path=()):
    """The dotted path of every number in the options, how long a list of them is by default (0: no list), and whether
    it is whole."""
    hints = get_type_hints(cls)
    for described in dataclasses.fields(cls):
        hint, here = hints[described.name], (*path, described.name)
        choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        for choice in choices:
            if dataclasses.is_dataclass(choice):
                yield from _numbers(choice, here)
            elif choice in (int, float):
                yield here, 0
            elif get_origin(choice) is tuple and get_args(choice)[0] in (int, float):
                yield here, len(described.default or (0.0,))


CASES = [
    (cls, path, length, value)
    for cls in REQUIRED
    for path, length in _numbers(cls)
    for value in NONSENSE
    if (".".join(path), value) not in ALLOWED
]


def _built(cls, path, value):
    values = dict(REQUIRED[cls])
    inner = values
    for name in path[:-1]:
        inner = inner.setdefault(name, {})
    inner[path[-1]] = value
    if cls in SCENES.values():
        kind = next(kind for kind, known in SCENES.items() if known is cls)
        if kind == "mesh":
            values["file"] = "some.ply"
        return build_scene(values | {"kind": kind}, "scene")
    return build(cls, values)


def _refusal(cls, path, value):
    """Why the options are refused; empty where they are not."""
    try:
        _built(cls, path, value)
    except OptionError as error:
        return str(error)
    return ""


def test_there_are_many_numbers():
    assert len(CASES) > 500


@pytest.mark.parametrize("cls", REQUIRED)
def test_nonsense_is_refused_with_the_name_of_the_option(cls):
    told = {
        (".".join(path), value): _refusal(cls, path, [value] * length if length else value)
        for wanted, path, length, value in CASES
        if wanted is cls
    }

    assert {
        case: words for case, words in told.items() if case[0].rpartition(".")[2] not in words or "\n" in words
    } == {}


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"features": {"max_features": 0}}, "features.max_features is 0, but must be finite and at least 1"),
        ({"features": {"max_features": 10**12}}, r"features.max_features is 1e\+12, but must be finite and at least 1"),
        ({"features": {"octave_layers": 10**4}}, "features.octave_layers is 10000, but must be finite and at least 1 "),
        ({"matching": {"ratio": 2.0}}, "matching.ratio is 2, but must be finite and above 0 and at most 1"),
        ({"sfm": {"global_growth": math.nan}}, "sfm.global_growth is nan, but must be finite and at least 1"),
        ({"sfm": {"final_rounds": 10**9}}, r"sfm.final_rounds is 1e\+09, but must be finite and at least 0"),
        ({"sfm": {"bundle": {"loss_scale": 0}}}, "sfm.bundle.loss_scale is 0, but must be finite and above 0"),
        ({"sfm": {"bundle": {"pixel_sigma": -1}}}, "sfm.bundle.pixel_sigma is -1, but must be finite and above 0"),
        ({"seed": 2**65}, r"seed is 3.68935e\+19, but must be finite and at least 0 and at most"),
        (
            {"sfm": {"bundle": {"refine": ["radial", "distortion"]}}},
            "sfm.bundle.refine has radial and distortion, but the first is part of the second",
        ),
    ],
)
def test_what_once_passed_is_named(values, sentence):
    with pytest.raises(OptionError, match=sentence):
        build(Options, values)


def test_what_makes_sense_at_the_edge_is_taken():
    assert build(Options, {"seed": 2**63, "matching": {"ratio": 1.0}, "sfm": {"global_growth": 1.0}}).seed == 2**63
    assert BundleOptions(refine=("radial", "focal")).refine == ("radial", "focal")


@pytest.mark.parametrize("out", ["", " "])
def test_results_need_a_folder(out):
    with pytest.raises(OptionError, match="out is empty, but must be the folder for the results"):
        build(OutputOptions, {"out": out})
