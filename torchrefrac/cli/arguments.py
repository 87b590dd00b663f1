"""The arguments of the command line, as Hydra needs them."""

import os
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, Quote, QuotedString, Sweep
from hydra.errors import OverrideParseException

from torchrefrac.cli.conf import CONF

QUIET = ("-q", "--quiet")
MULTIRUN = ("-m", "--multirun")
PATHS = (
    "alignment", "cache", "camera", "cameras", "capture", "cloud", "features.matches", "features.path",
    "features.weights", "matching.weights", "out", "photos", "run", "scene.file", "scene.path", "survey", "table",
    "tracks", "truth", "water.path", "water.surface",
)  # fmt: skip
"""The options that are names of files and folders."""
FEATURE_FILES = (".db", ".h5", ".hdf5")
"""How files of keypoints are called that other programs made."""
SEVERAL = ("photos",)
"""Of these the ones that may be lists of them."""

typed: list[str] = []
"""What the user typed after the name of the program; empty in a process that a launcher began."""


def for_hydra(arguments: Sequence[str]) -> list[str]:
    """The arguments in Hydra's own words: -q is `quiet=true`, options of a group wait for the jobs of a sweep, names of
    files and folders are texts, whatever people call their folders.

    Before it looks at the jobs, Hydra composes what all have in common, with the default choice of every group that is
    swept. `scene=tank,cans scene.depth=50` would then ask for the depth of the default scene, which has none; as the
    one choice of a sweep the option is left to the jobs.
    """
    given = ["quiet=true" if argument in QUIET else argument for argument in arguments]
    given = [word for argument in given for word in _with_file_of_features(argument)]
    is_sweep = any(argument in MULTIRUN or argument.startswith("sweep=") for argument in given)
    given = [_with_path(argument, is_sweep) for argument in given]
    if not is_sweep:
        return given
    groups = {path.name for path in CONF.iterdir() if path.is_dir()} - {"hydra"}
    return [_left_to_the_jobs(argument) if _head(argument) in groups else argument for argument in given]


def _with_file_of_features(argument: str) -> tuple[str, ...]:
    """`features=FILE` as the group and its path."""
    name, _, value = argument.partition("=")
    is_file = name == "features" and value.lower().endswith(FEATURE_FILES) and "," not in value
    return ("features=file", f"features.path={value}") if is_file else (argument,)


def _with_path(argument: str, is_sweep: bool) -> str:
    """The argument with its value as a text of Hydra's grammar, or several of them, where it is a path."""
    name, _, value = argument.partition("=")
    if name.lstrip("+") not in PATHS or not value:
        return argument
    if name in SEVERAL and value.startswith("[") and value.endswith("]"):
        parts = [_path_in_words_of_hydra(part.strip(), False) for part in value[1:-1].split(",")]
        return f"{name}=[{','.join(parts)}]"
    return f"{name}={_path_in_words_of_hydra(value, is_sweep)}"


def _path_in_words_of_hydra(path: str, is_sweep: bool) -> str:
    """As it is where Hydra takes it for a text, for null or, in a sweep, for a function of several; else in quotes.

    Hydra takes 2024 for a number, a (1) for a function, and does not understand H=40m, ~/pond and Überflug.
    """
    path = os.path.expanduser(path)
    override = _parsed(f"path={path}")
    value = None if override is None else override.value()
    if override is not None and isinstance(value, str | None):
        return path
    if is_sweep and isinstance(value, Sweep) and not _has_numbers(value):
        return path
    if is_sweep and "," in path:
        return ",".join(_path_in_words_of_hydra(part, False) for part in path.split(","))
    return QuotedString(path, Quote.single).with_quotes()


def _has_numbers(sweep: Sweep) -> bool:
    """Whether some of the values of a,b,c are no texts."""
    if not isinstance(sweep, ChoiceSweep) or not sweep.simple_form:
        return False
    return not all(isinstance(value, str | QuotedString) for value in sweep.list)


def _head(argument: str) -> str:
    """The first part of the name of an option that has several; else nothing."""
    name = argument.partition("=")[0]
    return name.partition(".")[0] if "." in name else ""


def _left_to_the_jobs(argument: str) -> str:
    override = _parsed(argument)
    if override is None or override.is_sweep_override() or override.is_delete():
        return argument
    return f"{override.get_key_element()}=choice({argument.partition('=')[2]})"


def _parsed(argument: str) -> Override | None:
    """None where Hydra does not understand it, and will name what is wrong with it."""
    try:
        (override,) = OverridesParser.create().parse_overrides([argument])
    except OverrideParseException:
        return None
    return override
