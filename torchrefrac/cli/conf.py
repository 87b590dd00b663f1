"""The YAML files of the options: where they lie, and each option with its default and its comment.

Hydra composes what a command runs with; it knows no comments, and loading it takes seconds. What is read here is for
people: `torchrefrac --help`.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml

PACKAGED = Path(__file__).resolve().parent.parent / "conf"
CONF = PACKAGED if PACKAGED.is_dir() else PACKAGED.parent.parent / "conf"
REQUIRED = "???"


@dataclass(frozen=True)
class Option:
    """Its dotted name, its default as it is written in the file, and its comment."""

    name: str
    default: str
    comment: str


@dataclass(frozen=True)
class Group:
    """A folder of files of which one is chosen: its name, the choice, and each file's first comment."""

    name: str
    choice: str | None
    choices: dict[str, str]


def read_options(file: Path, package: str, chosen: Mapping[str, str]) -> tuple[dict[str, Option], list[Group]]:
    """The options that `file` and the files of its defaults list have together, and the groups that it names.

    package: what the names begin with. chosen: choices of groups that take the place of those in the list. The file's
    own options come first; a comment that it leaves out is that of the file whose default it changes.

    Raises ValueError for a choice that does not exist.
    """
    text = file.read_text(encoding="utf-8")
    root = yaml.compose(text, _Loader)
    own = {option.name: option for option in _leaves(root, text.splitlines(), package)}
    others: dict[str, Option] = {}
    groups: list[Group] = []
    for key, listed in _defaults(root):
        folder, place = _target(key, file, package)
        choice = chosen.get(key, listed)
        if folder != file.parent:
            groups.append(read_group(folder.relative_to(CONF).as_posix(), choice))
        if choice is not None:
            others |= read_options(folder / f"{choice}.yaml", place, {})[0]
    for name, option in others.items():
        mine = own.get(name)
        own[name] = Option(name, mine.default, mine.comment or option.comment) if mine else option
    return own, groups


def read_group(name: str, choice: str | None) -> Group:
    """The group of that name; raises ValueError for a choice that does not exist."""
    choices = {path.stem: first_comment(path) for path in sorted((CONF / name).glob("*.yaml"))}
    if choice is not None and choice not in choices:
        raise ValueError(f"{name} is {choice!r}, but must be one of {', '.join(choices)}")
    return Group(name, choice, choices)


def read_header(file: Path) -> str:
    """The text of a command's file about the command itself."""
    return yaml.load(file.read_text(encoding="utf-8"), _Loader)["hydra"]["help"]["header"]


def first_comment(file: Path) -> str:
    """The comment that a file begins with, in one line."""
    lines = file.read_text(encoding="utf-8").splitlines()
    block = takewhile(lambda line: line.startswith("#"), lines)
    return " ".join(line[1:].strip() for line in block if not line.startswith("# @package"))


_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _defaults(root: yaml.MappingNode) -> list[tuple[str, str | None]]:
    """(group, choice) of the defaults list, without overrides of Hydra itself; a file beside it has no group."""
    found: list[tuple[str, str | None]] = []
    for key, value in root.value:
        if key.value == "defaults":
            for item in value.value:
                if isinstance(item, yaml.ScalarNode):
                    found += [] if item.value == "_self_" else [("", item.value)]
                else:
                    ((group, choice),) = item.value
                    known = None if choice.value == "null" else choice.value
                    found += [] if group.value.startswith("override ") else [(group.value, known)]
    return found


def _target(key: str, file: Path, package: str) -> tuple[Path, str]:
    """The folder of a group in a defaults list, and what the names of its options begin with."""
    group, _, place = key.partition("@")
    folder = CONF / group[1:] if group.startswith("/") else file.parent / group
    return folder, package if place == "_here_" or not group else _join(package, place or group.replace("/", "."))


def _leaves(node: yaml.MappingNode, lines: list[str], package: str) -> Iterator[Option]:
    for key, value in node.value:
        if key.value in ("defaults", "hydra") and node.start_mark.column == 0:
            continue
        name = _join(package, key.value)
        if isinstance(value, yaml.MappingNode) and value.value:
            yield from _leaves(value, lines, name)
        else:
            start, end = value.start_mark, value.end_mark
            default = lines[start.line][start.column : end.column if end.line == start.line else None]
            yield Option(name, default, _comment(key.start_mark, lines))


def _comment(mark: yaml.Mark, lines: list[str]) -> str:
    """What stands behind an option, else above it; the comment that the file begins with belongs to the whole file."""
    behind = re.search(r"\s#\s+(.*)$", lines[mark.line])
    if behind:
        return behind[1]
    above: list[str] = []
    for line in reversed(lines[: mark.line]):
        if not line.startswith(" " * mark.column + "#"):
            return " ".join(reversed(above))
        above.append(line.strip()[1:].strip())
    return ""


def _join(package: str, name: str) -> str:
    return f"{package}.{name}" if package else name
