"""Every public name is in the pages of the reference, in whole sentences, with units and errors.

Shapes stand in the signatures, which `test_signatures` checks of the whole package.
"""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import pytest

import torchrefrac

PAGES = Path(__file__).resolve().parents[1] / "docs" / "reference"
PACKAGE = Path(torchrefrac.__file__).parent
ERRORS = {
    name
    for file in PACKAGE.rglob("*.py")
    for name in re.findall(r"^class (\w+Error)\b", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
} | {"ValueError", "KeyError", "TypeError"}
MODULES = ("bundle", "minimal", "ransac", "refinement", "sfm")
# What a docstring must name where an argument or a field is called like that, unless its name ends in the unit.
UNITS_OF = {
    r"(\w+_)?pixels|(\w+_)?pixel_sigma|max_error|loss_scale|focal|principal_point": r"pixel|px\b",
    r"(\w*_)?(height|depth|distance|thickness|position|center)|points|offset|origin": r"length|unit\b|metre|\bm\b",
    r"tilt|heading|gravity_sigma|down_sigma": r"radian|degree",
}
UNIT_IN_NAME = re.compile(r"_(deg|px|m|nm|c|psu|hours)$")
SENTENCES = re.compile(r"[^a-z\s].*\.", flags=re.DOTALL)


def _public() -> dict[str, Any]:
    """Every public name that is no module, with what it stands for."""
    names = {name: getattr(torchrefrac, name) for name in torchrefrac.__all__}
    for module in MODULES:
        part = getattr(torchrefrac, module)
        names |= {f"{module}.{name}": getattr(part, name) for name in part.__all__}
    return {name: value for name, value in names.items() if not isinstance(value, ModuleType)}


PUBLIC = _public()
PROTOCOLS = [value for value in PUBLIC.values() if getattr(value, "_is_protocol", False)]
IN_PAGES = [
    line.removeprefix("::: torchrefrac.").strip()
    for page in sorted(PAGES.glob("*.md"))
    for line in page.read_text(encoding="utf-8").splitlines()
    if line.startswith(":::")
]


class Documented(NamedTuple):
    """What has a docstring of its own: a class, a function, or a public method."""

    name: str
    said: str  # by the docstring
    beside: str  # by that of the class, which stands beside it in the page
    takes: tuple[str, ...]
    source: str


def _documented(value: Any) -> Iterator[Documented]:
    if not inspect.isclass(value):
        plain = inspect.unwrap(value)
        yield Documented(value.__name__, _doc(plain), "", tuple(inspect.signature(plain).parameters), _source(plain))
        return
    own = _doc(value)
    made_by = [vars(value)[name] for name in ("__init__", "__post_init__") if _is_written(vars(value).get(name))]
    takes = [field.name for field in fields(value)] if is_dataclass(value) else []
    takes += [name for made in made_by for name in inspect.signature(made).parameters]
    yield Documented(value.__name__, own, "", tuple(takes), "\n".join(map(_source, made_by)))
    for name, part in vars(value).items():
        found = part.fget if isinstance(part, property) else getattr(part, "__func__", part)
        if name.startswith("_") or not _is_written(found) or not (_doc(found) or not _of_protocol(name)):
            continue
        plain = inspect.unwrap(found)
        takes = tuple(inspect.signature(plain).parameters)
        yield Documented(f"{value.__name__}.{name}", _doc(plain), own, takes, _source(plain))


def _is_written(value: object) -> bool:
    """Whether it is a function of the package that somebody wrote, not one that a decorator made up."""
    return inspect.isfunction(value) and PACKAGE in Path(inspect.unwrap(value).__code__.co_filename).parents


def _of_protocol(name: str) -> bool:
    """Whether a protocol says what the method is for."""
    return any(_doc(vars(protocol).get(name)) for protocol in PROTOCOLS)


def _doc(value: object) -> str:
    own = vars(value).get("__doc__") if inspect.isclass(value) else getattr(value, "__doc__", None)
    return inspect.cleandoc(own or "")


def _source(function: Any) -> str:
    return textwrap.dedent(inspect.getsource(inspect.unwrap(function)))


def _raised(source: str) -> set[str]:
    """Errors that a function raises itself."""
    raised = [node.exc for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Raise)]
    return {exc.func.id for exc in raised if isinstance(exc, ast.Call) and isinstance(exc.func, ast.Name)} & ERRORS


def _found(name: str) -> Any:
    """What stands under a name in the pages: of a public name, or of the module that it comes from, where a module has
    the public name too and the pages would show that."""
    module, _, last = name.rpartition(".")
    return PUBLIC[name] if name in PUBLIC else getattr(import_module(f"torchrefrac.{module}"), last)


def test_the_reference_has_every_public_name_once_and_no_module_in_its_place():
    found = [id(_found(name)) for name in IN_PAGES]
    files = [PACKAGE.joinpath(*name.split(".")) for name in IN_PAGES]

    assert len(found) == len(set(found))
    assert [name for name, value in PUBLIC.items() if id(value) not in found] == []
    assert set(found) <= {id(value) for value in PUBLIC.values()}
    assert [file for file in files if file.is_dir() or file.with_suffix(".py").is_file()] == []


@pytest.mark.parametrize("name", sorted(IN_PAGES))
def test_a_docstring_is_of_sentences_and_names_units_and_errors(name):
    lacking = []
    for part in _documented(_found(name)):
        if not SENTENCES.fullmatch(part.said):
            lacking.append(f"{part.name}: whole sentences")
        lacking += [f"{part.name}: {error}" for error in _raised(part.source) if error not in part.said]
        lacking += [
            f"{part.name}: the unit of {argument}"
            for argument in part.takes
            for names, units in UNITS_OF.items()
            if re.fullmatch(names, argument) and not UNIT_IN_NAME.search(argument)
            if not re.search(units, part.said + part.beside)
        ]

    assert lacking == []


def test_the_functions_that_are_named_beside_the_equations_of_the_paper_are_there():
    named = re.findall(r"`([\w/]+\.py)::(\w+)`", (PAGES.parent / "paper.md").read_text(encoding="utf-8"))

    assert len(named) > 30
    assert [
        f"{file}::{name}"
        for file, name in named
        if not re.search(rf"^ *(def|class) {name}\b", (PACKAGE / file).read_text(encoding="utf-8"), flags=re.MULTILINE)
    ] == []
