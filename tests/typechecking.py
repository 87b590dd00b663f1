"""Signatures come true in tests: the package's functions are imported with checks of what they take and give back.

An import hook decorates every function whose signature has shapes (jaxtyping), and every dataclass and named tuple with
such fields. Arguments that do not fit are the package's own to refuse: the function runs, and if it returns although
its signature excludes what it was given, that is the error. TORCHREFRAC_PLAIN=1 imports the package as it is.
"""

import ast
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import InitVar, is_dataclass
from functools import wraps
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from inspect import Parameter, Signature, isgeneratorfunction, signature, unwrap
from multiprocessing import parent_process
from types import ModuleType
from typing import Any, Self, get_type_hints, runtime_checkable

import torch
from beartype import BeartypeConf
from beartype.door import is_bearable
from jaxtyping import _storage
from torch import Tensor
from typing_extensions import is_protocol

PACKAGE = "torchrefrac"
NAME = "__checked__"  # of the decorator in the modules of the package
CONF = BeartypeConf(is_pep484_tower=True)
EVERY_CALL, ONE_IN = 16, 64  # the first calls of a function in a process are all checked, later ones in part
_stated: dict[Any, tuple[Signature, dict[str, Any]]] = {}


class SignatureError(AssertionError):
    """A value that does not fit the signature; no ValueError, so that no test takes it for a refusal by the package."""


def install() -> None:
    """From here on the package is imported with checks; workers that a test begins take it as it is."""
    if os.environ.get("TORCHREFRAC_PLAIN") == "1" or parent_process() is not None:
        return
    assert PACKAGE not in sys.modules, "the package was imported before its checks were installed"
    sys.meta_path.insert(0, _Finder())


def checked(item: Any) -> Any:
    """A function or class with checks of its arguments and results; as it is where no shapes are stated."""
    if isinstance(item, type):
        if is_dataclass(item):
            item.__init__ = checked(item.__init__)
        elif issubclass(item, tuple) and "__new__" in vars(item):
            item.__new__ = checked(item.__new__)
        elif issubclass(item, torch.autograd.Function):  # which the compiler looks into
            for name, method in list(vars(item).items()):
                if isinstance(method, staticmethod):
                    setattr(item, name, staticmethod(unwrap(method.__func__)))
        return runtime_checkable(item) if is_protocol(item) else item
    shapes = "jaxtyping." in repr(getattr(item, "__annotations__", {}))
    if not shapes or isgeneratorfunction(item) or torch.compiler.is_compiling():
        return item

    calls = [0]

    @wraps(item)
    def with_checks(*args: Any, **kwargs: Any) -> Any:
        if torch.compiler.is_compiling():
            return item(*args, **kwargs)
        calls[0] += 1
        if calls[0] > EVERY_CALL and calls[0] % ONE_IN:  # oracles call small functions a million times
            return item(*args, **kwargs)
        return _call(item, args, kwargs)

    return with_checks


def _call(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """`function` of these arguments, with checks. Trees of anything may have the form of a named tuple."""
    if function.__name__ == "__new__" and not any(isinstance(value, Tensor) for value in (*args, *kwargs.values())):
        return function(*args, **kwargs)
    name = f"{function.__module__}.{function.__qualname__}"
    key = (name, function.__code__)
    if key not in _stated:  # at the first call all names that stand in strings are known
        _stated[key] = _statements(function)
    of, hints = _stated[key]
    bound = of.bind(*args, **kwargs)
    given = dict(bound.arguments)
    bound.apply_defaults()
    _storage.push_shape_memo(bound.arguments)  # a call's own sizes; `jaxtyped("context")` knows no "{count}"
    try:
        misfits = [key for key, value in given.items() if not is_bearable(value, hints[key], conf=CONF)]
        result = function(*args, **kwargs)
        if misfits:
            key = misfits[0]
            raise SignatureError(f"{name} accepts {key} = {_in_short(given[key])}, but states {hints[key]}")
        if not is_bearable(result, hints["return"], conf=CONF):
            sizes = ", ".join(f"{key} = {_in_short(value)}" for key, value in given.items())
            raise SignatureError(f"{name} gives {_in_short(result)}, but states {hints['return']}; of {sizes}")
        return result
    finally:
        _storage.pop_shape_memo()


def _statements(function: Callable[..., Any]) -> tuple[Signature, dict[str, Any]]:
    """The signature, and the type of each parameter and of the result; what is not stated, or known to type checkers
    alone, such as the class that a method is called of, may be anything."""
    try:
        stated = get_type_hints(function)
    except NameError:
        stated = {key: Any if isinstance(hint, str) else hint for key, hint in function.__annotations__.items()}
    stated = {key: hint.type if isinstance(hint, InitVar) else hint for key, hint in stated.items() if hint is not Self}
    hints, of = {"return": stated.get("return", Any)}, signature(function)
    for key, parameter in of.parameters.items():
        hint = stated.get(key, Any)
        several = {Parameter.VAR_POSITIONAL: tuple[hint, ...], Parameter.VAR_KEYWORD: dict[str, hint]}
        hints[key] = several.get(parameter.kind, hint)
    return of, hints


def _in_short(value: Any) -> str:
    """A value in short: of tensors the kind and the shape."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, list | tuple):
        return f"({', '.join(map(_in_short, value[:6]))})"
    return repr(value)[:80]


class _Loader(SourceFileLoader):
    """Decorates what has annotations; nothing comes from the cache of bytecode, nor gets there."""

    def get_code(self, fullname: str) -> Any:
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path), path)
        for node in _definitions(tree):
            decorator = ast.copy_location(ast.Name(NAME, ast.Load()), node)
            # Of classes outermost, after `dataclass`; of functions innermost, where the annotations still stand.
            node.decorator_list.insert(0 if isinstance(node, ast.ClassDef) else len(node.decorator_list), decorator)
        return compile(tree, path, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        setattr(module, NAME, checked)
        super().exec_module(module)


def _definitions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef))


class _Finder(MetaPathFinder):
    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if fullname.partition(".")[0] != PACKAGE:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec
