"""Shapes stand in every signature, and what does not fit them is found in tests."""

import ast
import os
from collections.abc import Iterator
from dataclasses import InitVar, dataclass
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor

import torchrefrac
from tests.typechecking import SignatureError, checked
from torchrefrac.camera import RefractiveCamera
from torchrefrac.refraction import solve_refrax

PACKAGE = Path(torchrefrac.__file__).parent
FILES = sorted((*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "hydra_plugins").rglob("*.py")))
SHAPED = {"Bool", "Complex", "Float", "Float32", "Int", "Real", "Shaped", "UInt8"}


def test_every_tensor_in_a_signature_has_a_shape():
    assert len(FILES) > 200
    assert [f"{file.relative_to(PACKAGE.parent)}:{line}" for file in FILES for line in _without_shape(file)] == []


def _without_shape(file: Path) -> Iterator[int]:
    """Lines of annotations, and of names for types, in which a tensor stands without a shape."""
    tree = ast.parse(file.read_text())
    for node in ast.walk(tree):
        stated: list[ast.expr | None] = []
        if isinstance(node, ast.FunctionDef):
            of = node.args
            arguments = (*of.posonlyargs, *of.args, *of.kwonlyargs, of.vararg, of.kwarg)
            stated = [node.returns, *(argument.annotation for argument in arguments if argument is not None)]
        elif isinstance(node, ast.ClassDef):
            stated = [part.annotation for part in node.body if isinstance(part, ast.AnnAssign)]
        elif isinstance(node, ast.Module):
            stated = [part.value for part in node.body if isinstance(part, ast.Assign)]
        for annotation in stated:
            if annotation is not None and _is_bare(annotation):
                yield annotation.lineno


def _is_bare(node: ast.AST) -> bool:
    match node:
        case ast.Name(id="Tensor") | ast.Attribute(attr="Tensor" | "ndarray"):
            return True
        case ast.Subscript(value=ast.Name(id=kind)) if kind in SHAPED:
            return False
        case ast.Constant(value=str(text)) if "Tensor" in text:
            return _is_bare(ast.parse(text, mode="eval"))
        case ast.Call():
            return False
    return any(_is_bare(child) for child in ast.iter_child_nodes(node))


@checked
def _scaled(
    points: Float[Tensor, "n 3"], by: Float[Tensor, " n"] | float, gives: str = "right"
) -> Float[Tensor, "n 3"]:
    if points.shape[-1] != 3 and gives != "anything":
        raise ValueError("points must have three components")
    return points[:1] if gives == "few" else points * torch.as_tensor(by)[..., None]


@checked
@dataclass(frozen=True)
class _Cloud:
    points: Float[Tensor, "n 3"]
    colors: Int[Tensor, "n 3"] | None = None
    check: InitVar[bool] = True

    def __post_init__(self, check: bool) -> None:
        assert check


@checked
class _Pair(NamedTuple):
    first: Float[Tensor, "*batch"]
    second: Float[Tensor, "*batch"]


def test_what_fits_its_signature_passes():
    points = torch.ones(2, 3)

    assert _scaled(points, 2).sum() == 12.0
    assert _scaled(points, by=torch.ones(2)).sum() == 6.0
    assert _Cloud(points, points.long()).colors is not None
    assert _Pair(points, points)[0] is points


def test_a_function_refuses_by_itself_what_does_not_fit():
    with pytest.raises(ValueError, match="three components"):
        _scaled(torch.ones(2, 4), 2.0)


@pytest.mark.parametrize(
    ("points", "by", "gives", "words"),
    [
        (torch.ones(2, 4), 2.0, "anything", r"accepts points = torch\.float32\[2, 4\]"),
        (torch.ones(2, 3), torch.ones(1), "right", r"accepts by = torch\.float32\[1\]"),
        (torch.ones(2, 3), 2.0, "few", r"gives torch\.float32\[1, 3\]"),
        (torch.ones(2, 3, dtype=torch.int64), 2.0, "right", r"accepts points = torch\.int64\[2, 3\]"),
    ],
)
def test_what_a_function_accepts_or_gives_against_its_signature_is_found(points, by, gives, words):
    with pytest.raises(SignatureError, match=words):
        _scaled(points, by, gives)


def test_fields_that_do_not_fit_are_found():
    with pytest.raises(SignatureError, match=r"accepts colors"):
        _Cloud(torch.ones(2, 3), torch.ones(2, 3))
    with pytest.raises(SignatureError, match=r"accepts second"):
        _Pair(torch.ones(2), torch.ones(3))


@pytest.mark.skipif(os.environ.get("TORCHREFRAC_PLAIN") == "1", reason="the package is imported as it is")
def test_the_package_is_imported_with_checks():
    assert hasattr(solve_refrax, "__wrapped__")
    assert hasattr(RefractiveCamera.__init__, "__wrapped__")


def test_compiled_code_runs_the_plain_function():
    compiled = torch.compile(_scaled, fullgraph=True, backend="eager")

    assert compiled(torch.ones(2, 3), torch.ones(2)).sum() == 6.0
