"""The arguments of the command line, as Hydra needs them."""

from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException

from torchrefrac.cli.conf import CONF

QUIET = ("-q", "--quiet")
MULTIRUN = ("-m", "--multirun")

typed: list[str] = []
"""What the user typed after the name of the program; empty in a process that a launcher began."""


def for_hydra(arguments: Sequence[str]) -> list[str]:
    """The arguments in Hydra's own words: -q is `quiet=true`, and options of a group wait for the jobs of a sweep.

    Before it looks at the jobs, Hydra composes what all have in common, with the default choice of every group that is
    swept. `scene=tank,cans scene.depth=50` would then ask for the depth of the default scene, which has none; as the
    one choice of a sweep the option is left to the jobs.
    """
    given = ["quiet=true" if argument in QUIET else argument for argument in arguments]
    if not any(argument in MULTIRUN or argument.startswith("sweep=") for argument in given):
        return given
    groups = {path.name for path in CONF.iterdir() if path.is_dir()} - {"hydra"}
    return [_left_to_the_jobs(argument) if _head(argument) in groups else argument for argument in given]


def _head(argument: str) -> str:
    """The first part of the name of an option that has several; else nothing."""
    name = argument.partition("=")[0]
    return name.partition(".")[0] if "." in name else ""


def _left_to_the_jobs(argument: str) -> str:
    try:
        (override,) = OverridesParser.create().parse_overrides([argument])
    except OverrideParseException:
        return argument  # Hydra names what is wrong with it
    if override.is_sweep_override() or override.is_delete():
        return argument
    return f"{override.get_key_element()}=choice({argument.partition('=')[2]})"
