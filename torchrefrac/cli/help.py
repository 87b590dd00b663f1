"""What `torchrefrac --help` prints: every option with its default and its comment, by groups."""

from collections.abc import Iterable, Iterator, Sequence
from textwrap import wrap

from torchrefrac.cli.conf import CONF, REQUIRED, Group, Option, read_group, read_header, read_options

WIDTH, COLUMN = 100, 36
COMMANDS = ("adjust", "calibrate", "correct", "densify", "export", "import", "triangulate")
FILES = {name: f"{name}.yaml" for name in COMMANDS}
FLAGS = {
    "-m, --multirun": "a sweep: one run for each combination of values that are separated by commas",
    "-q, --quiet": "nothing but errors is printed",
    "-c job, --cfg job": "prints the options that a command would run with",
    "-h, --help": "this text; with GROUP=CHOICE it shows the options of that choice",
    "--version": "the version",
}


def help_text(arguments: Sequence[str]) -> str:
    """The help of the command that `arguments` name, for the choices of groups among them.

    Raises ValueError for a choice that does not exist.
    """
    given = [argument for argument in arguments if not argument.startswith("-")]
    file = CONF / FILES.get(given[0] if given else "", "config.yaml")
    chosen = dict(argument.split("=", maxsplit=1) for argument in given if "=" in argument)
    options, groups = read_options(file, "", {group: value.split(",")[0] for group, value in chosen.items()})
    if file.name == "config.yaml":
        groups.append(read_group("hydra/launcher", None))
    lines = [read_header(file).rstrip(), "", "Flags"]
    for flag, meaning in FLAGS.items():
        lines += _row(flag, meaning)
    return "\n".join([*lines, *_sections(list(options.values()), groups)])


def _sections(options: Sequence[Option], groups: Iterable[Group]) -> Iterator[str]:
    """What belongs to no group, then a section for each group: its choices, and the options of the one chosen."""
    titles = {group.name.rpartition("/")[2]: group for group in groups}
    loose = [option for option in options if option.name.partition(".")[0] not in titles]
    yield from ("", "Options (NAME=VALUE)", *_rows(loose))
    for title, group in titles.items():
        yield from ("", f"{group.name}={group.choice}" if group.choice else group.name)
        if len(group.choices) > 1:
            for choice, meaning in group.choices.items():
                yield from _row(f"{group.name}={choice}", meaning)
        yield from _rows([option for option in options if option.name.partition(".")[0] == title])


def _rows(options: Iterable[Option]) -> Iterator[str]:
    for option in options:
        required = option.default == REQUIRED
        shown = f"{option.name}=VALUE" if required else f"{option.name}={option.default}"
        yield from _row(shown, f"required: {option.comment}" if required else option.comment)


def _row(left: str, right: str) -> list[str]:
    """Two columns; what does not fit into the first has a line of its own."""
    text = wrap(right, WIDTH - COLUMN) or [""]
    head = f"  {left}"
    rest = [f"{'':<{COLUMN}}{line}" for line in text]
    return [head, *rest] if len(head) > COLUMN - 2 else [f"{head:<{COLUMN}}{text[0]}", *rest[1:]]
