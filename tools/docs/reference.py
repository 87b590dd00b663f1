"""What the pages of the reference show of the sources: an extension of griffe, which reads them for mkdocstrings.

Docstrings are plain text: their asterisks are of shapes (*B), not of Markdown. Names that a module has for types are
replaced by what they stand for, so that every signature shows the shapes of its tensors. What makes a dataclass is not
in the sources; its source is that of the class.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from typing import Any

from griffe import Alias, AliasResolutionError, Attribute, Class, Expr, ExprName, Extension, Function, Module, Object

CODE = re.compile(r"(`[^`]*`|^ {4}.*$)", flags=re.MULTILINE)
SHOWN = re.compile(r"Tensor|Literal")


class Reference(Extension):
    """Escapes what Markdown would take for emphasis, and writes out the names of types."""

    def on_package(self, *, pkg: Module, **_: Any) -> None:
        """Change all that was read of a package."""
        for part in _parts(pkg):
            if part.docstring is not None:
                part.docstring.value = plain(part.docstring.value)
            if isinstance(part, Attribute):
                part.annotation = written_out(part.annotation, part.module)
            elif isinstance(part, Function):
                if not part.lineno and part.parent is not None:
                    part.lineno, part.endlineno = part.parent.lineno, part.parent.endlineno
                part.returns = written_out(part.returns, part.module)
                for parameter in part.parameters:
                    parameter.annotation = written_out(parameter.annotation, part.module)


def plain(text: str) -> str:
    """Markdown that shows the text as it is, but for its code."""
    parts = CODE.split(text)
    parts[::2] = [part.replace("*", r"\*") for part in parts[::2]]
    return "".join(parts)


def written_out(annotation: Any, module: Module) -> Any:
    """An annotation whose names for shapes and choices are replaced by what they stand for in the module."""
    if isinstance(annotation, ExprName):
        named = module.members.get(annotation.name)
        with suppress(AliasResolutionError):
            named = named.final_target if isinstance(named, Alias) else named
            if isinstance(named, Attribute) and SHOWN.search(str(named.value)):
                return written_out(named.value, named.module)
    elif isinstance(annotation, Expr):
        for field in fields(annotation):
            value = getattr(annotation, field.name)
            if isinstance(value, Expr):
                setattr(annotation, field.name, written_out(value, module))
            elif isinstance(value, list):
                setattr(annotation, field.name, [written_out(each, module) for each in value])
    return annotation


def _parts(part: Object) -> Iterator[Object]:
    yield part
    for member in part.members.values():
        if isinstance(member, Module | Class | Function | Attribute):
            yield from _parts(member)
