"""Checks of what users hand in."""

import math
import pkgutil
from importlib import import_module

import pytest
import torch

import torchrefrac
from torchrefrac.checks import (
    TorchrefracError,
    at_least_single,
    holds_everywhere,
    is_wrapped,
    require,
    require_broadcasting,
    require_ending,
    require_floating,
    require_rotation,
)


@pytest.mark.parametrize("value", [0.0, 1.0, 2, torch.tensor(0.5), torch.tensor([0.0, 1.0]), torch.tensor([0, 1])])
def test_values_within_the_bounds_pass(value):
    require(value, "value", at_least=0.0, at_most=2.0)
    require(value, "value", above=-1.0)
    require(value, "value")


@pytest.mark.parametrize(
    ("bounds", "value", "words"),
    [
        ({"at_least": 0.0}, -0.5, "value is -0.5, but must be finite and at least 0"),
        ({"above": 0.0}, 0.0, "value is 0, but must be finite and above 0"),
        ({"at_most": 2.0}, 2.5, "value is 2.5, but must be finite and at most 2"),
        ({"at_least": 0.0, "at_most": 2.0}, 3.0, "value is 3, but must be finite and at least 0 and at most 2"),
        ({}, math.nan, "value is nan, but must be finite"),
        ({}, -math.inf, "value is -inf, but must be finite"),
        ({"at_least": 0.0}, math.inf, "value is inf, but must be finite and at least 0"),
        ({"at_most": 0.0}, math.nan, "value is nan, but must be finite and at most 0"),
    ],
)
def test_a_value_outside_is_named_with_what_it_is_and_what_it_must_be(bounds, value, words):
    with pytest.raises(ValueError, match=f"^{words}$"):
        require(value, "value", **bounds)
    with pytest.raises(ValueError, match=f"^{words}$"):
        require(torch.tensor(value), "value", **bounds)
    with pytest.raises(ValueError, match=f"^{words.replace(',', ' somewhere,', 1)}$"):
        require(torch.tensor([1.0, value, 1.0] if "at_most" in bounds else [value]), "value", **bounds)


@pytest.mark.parametrize("shape", [(0,), (3, 0)])
def test_there_is_nothing_wrong_with_no_values(shape):
    require(torch.empty(shape), "value", above=0.0)


@pytest.mark.parametrize("transform", ["vmap", "vmap of vmap", "jacfwd", "jacrev", "vmap of jacfwd"])
def test_the_values_inside_a_transform_are_checked(transform):
    def checked(value):
        require(value, "value", at_least=0.0)
        return 2.0 * value

    run = {
        "vmap": torch.func.vmap(checked),
        "vmap of vmap": torch.func.vmap(torch.func.vmap(checked)),
        "jacfwd": torch.func.jacfwd(checked),
        "jacrev": torch.func.jacrev(checked),
        "vmap of jacfwd": torch.func.vmap(torch.func.jacfwd(checked)),
    }[transform]

    run(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    with pytest.raises(ValueError, match="value is -1"):
        run(torch.tensor([[1.0, 2.0], [-1.0, 4.0]]))


def test_compiled_code_is_not_checked():
    def checked(value):
        require(value, "value", at_least=0.0)
        return 2.0 * value

    compiled = torch.compile(checked, fullgraph=True, backend="eager")

    assert compiled(torch.tensor([-1.0])).tolist() == [-2.0]


def test_tensors_of_whole_numbers_are_refused_where_floating_point_is_wanted():
    for good in (1, 1.0, torch.ones(2), torch.ones(2, dtype=torch.float16)):
        require_floating(good, "value")
    with pytest.raises(ValueError, match=r"^value is True, but must be a number$"):
        require_floating(True, "value")
    for bad in (torch.ones(2, dtype=torch.int32), torch.ones(2, dtype=torch.bool)):
        with pytest.raises(ValueError, match=rf"^value has dtype {bad.dtype}, but must be a floating-point tensor$"):
            require_floating(bad, "value")


@pytest.mark.parametrize(
    ("ending", "bad", "wants"), [((3,), (3, 2), r"\(3,\)"), ((3,), (), r"\(3,\)"), ((3, 3), (3,), r"\(3, 3\)")]
)
def test_a_shape_with_another_ending_is_refused(ending, bad, wants):
    require_ending(torch.zeros(*ending), "value", ending)
    require_ending(torch.zeros(5, 2, *ending), "value", ending)
    with pytest.raises(ValueError, match=rf"^value has shape .*, but must end in {wants}$"):
        require_ending(torch.zeros(bad), "value", ending)


NO_ROTATIONS = {
    "scaled": torch.eye(3) * 1.01,
    "sheared": torch.eye(3) + 0.01 * torch.ones(3, 3).triu(1),
    "a reflection": torch.diag(torch.tensor([1.0, 1.0, -1.0])),
    "zero": torch.zeros(3, 3),
    "third row alone": torch.diag(torch.tensor([1.0, 1.0, 1.01])),
}


@pytest.mark.parametrize("name", NO_ROTATIONS)
def test_a_matrix_that_is_no_rotation_is_refused(draw, name):
    rotations = draw.rotations(4)

    with pytest.raises(ValueError, match=r"^pose must be a rotation: its rows are off by .* somewhere"):
        require_rotation(NO_ROTATIONS[name], "pose")
    with pytest.raises(ValueError, match=r"^pose must be a rotation"):
        require_rotation(torch.cat((rotations, rotations[:1] @ NO_ROTATIONS[name].double())), "pose")


def test_a_matrix_that_is_not_finite_is_no_rotation():
    with pytest.raises(ValueError, match=r"^pose is nan somewhere"):
        require_rotation(torch.full((3, 3), math.nan), "pose")


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16, torch.float16])
def test_rotations_pass_in_every_precision(draw, dtype):
    rotations = draw.rotations(50)

    require_rotation(rotations.to(dtype), "pose")
    require_rotation((rotations * 1e4).round() / 1e4, "pose")  # as a file with four digits has them
    require_rotation(rotations[:0].to(dtype), "pose")
    torch.func.vmap(lambda r: require_rotation(r, "pose") or r, in_dims=1)(rotations.movedim(0, 1).to(dtype))


def test_every_named_error_of_the_package_has_the_one_base():
    modules = [m.name for m in pkgutil.walk_packages(torchrefrac.__path__, "torchrefrac.") if "__main__" not in m.name]
    classes = {value for name in modules for value in vars(import_module(name)).values() if isinstance(value, type)}
    errors = [c for c in classes if issubclass(c, Exception) and c.__module__.startswith("torchrefrac.")]

    assert len(errors) > 10
    assert [c for c in errors if not issubclass(c, TorchrefracError)] == []


def test_shapes_broadcast_or_are_listed():
    assert require_broadcasting(a=(2, 1), b=(3,), c=()) == (2, 3)
    with pytest.raises(ValueError, match=r"^shapes do not broadcast: a \(2,\), b \(3,\), c \(\)$"):
        require_broadcasting(a=(2,), b=(3,), c=())


def test_half_precision_is_raised_and_the_rest_is_left():
    for dtype in (torch.float16, torch.bfloat16):
        assert at_least_single(torch.ones(1, dtype=dtype)).dtype == torch.float32
    for dtype in (torch.float32, torch.float64):
        value = torch.ones(1, dtype=dtype)
        assert at_least_single(value) is value


def test_a_mask_holds_everywhere_or_not():
    assert holds_everywhere(torch.tensor([True, True]))
    assert holds_everywhere(torch.tensor(True))
    assert holds_everywhere(torch.empty(0, dtype=torch.bool))
    assert not holds_everywhere(torch.tensor([True, False]))


def test_a_transform_is_known_from_a_plain_tensor():
    seen = []

    torch.func.vmap(lambda x: seen.append(is_wrapped(x)) or x)(torch.ones(2))

    assert seen == [True]
    assert not is_wrapped(torch.ones(2))
