"""Typed options out of plain mappings. YAML is read elsewhere."""

import dataclasses
import types
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from torchrefrac.checks import TorchrefracError

T = TypeVar("T")
PLAIN: dict[Any, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


class OptionError(TorchrefracError, ValueError):
    """An option is unknown, missing or of the wrong type; the message names it."""


def build(cls: type[T], values: Mapping[str, Any], path: str = "") -> T:
    """An instance of the dataclass `cls` from nested plain values, strictly.

    Raises OptionError that names the option (dotted) for an unknown or missing one, or one of the wrong type. A whole
    number serves where a float is wanted.
    """
    hints = get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in values:
        if name not in fields:
            raise OptionError(f"{_join(path, name)} is not an option; known here are {', '.join(fields)}")
    arguments = {}
    for name, described in fields.items():
        if name in values:
            arguments[name] = _convert(hints[name], values[name], _join(path, name))
        elif described.default is dataclasses.MISSING and described.default_factory is dataclasses.MISSING:
            raise OptionError(f"{_join(path, name)} is missing")
    try:
        return cls(**arguments)
    except OptionError:
        raise
    except ValueError as error:  # from options of a layer that does not know how they are read
        raise OptionError(_join(path, str(error))) from None


def _convert(hint: Any, value: Any, path: str) -> Any:
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if not isinstance(value, Mapping):
            raise OptionError(f"{path} is {value!r}, but must be a group of options")
        return build(hint, value, path)
    origin = get_origin(hint)
    if origin is Literal:
        choices = get_args(hint)
        if value not in choices:
            raise OptionError(f"{path} is {value!r}, but must be one of {', '.join(map(str, choices))}")
        return value
    if origin in (Union, types.UnionType):
        return _convert_union(get_args(hint), value, path)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise OptionError(f"{path} is {value!r}, but must be a list")
        return tuple(_convert(get_args(hint)[0], item, f"{path}[{i}]") for i, item in enumerate(value))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise OptionError(f"{path} has {value.bit_length()} binary digits, but must be a finite number") from None
    if type(value) is not hint:
        raise OptionError(f"{path} is {value!r}, but must be {PLAIN.get(hint)}")
    return value


def _convert_union(choices: tuple[Any, ...], value: Any, path: str) -> Any:
    """A value of one of some kinds, or a list, or null or one of some words where these are among the choices."""
    words = [word for choice in choices if get_origin(choice) is Literal for word in get_args(choice)]
    if value in words or (value is None and type(None) in choices):
        return value
    kinds = [choice for choice in choices if choice is not type(None) and get_origin(choice) is not Literal]
    groups = [kind for kind in kinds if dataclasses.is_dataclass(kind)]
    if len(groups) > 1 and isinstance(value, Mapping):
        return _convert(_by_method(groups, value, path), value, path)
    fitting = [kind for kind in kinds if isinstance(value, list | tuple if get_origin(kind) is tuple else kind)]
    kind = (fitting or kinds)[0]
    try:
        return _convert(kind, value, path)
    except OptionError as error:
        raise OptionError(", or ".join((str(error), *words))) from None


def _by_method(groups: list[Any], value: Mapping[str, Any], path: str) -> Any:
    """Of groups of options the one whose `method` is named, by default the first."""
    known = {method: group for group in groups for method in get_args(get_type_hints(group)["method"])}
    method = value.get("method", next(iter(known)))
    if method not in known:
        raise OptionError(f"{path}.method is {method!r}, but must be one of {', '.join(known)}")
    return known[method]


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
