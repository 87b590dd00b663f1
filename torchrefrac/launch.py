"""Starts the command line in a process that shares its processors well."""

import os
import sys

from torchrefrac import __version__
from torchrefrac.cli.streams import unbroken_streams


def main() -> None:
    """Entry point of the `torchrefrac` command. Version and help are there at once, without PyTorch and Hydra.

    OpenMP's threads wait by spinning unless told otherwise before PyTorch is loaded. Beside one other busy process that
    makes a run several times slower, for nothing in return: its many small operations hardly profit from spinning.
    """
    with unbroken_streams():
        _run(sys.argv[1:])


def _run(arguments: list[str]) -> None:
    if "--version" in arguments:
        print(f"torchrefrac {__version__}")
    elif "--help" in arguments or "-h" in arguments:
        from torchrefrac.cli.help import help_text  # noqa: PLC0415 - only help needs it

        try:
            print(help_text(arguments))
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(1)
    else:
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        from torchrefrac.cli.main import main as run_command  # noqa: PLC0415 - loads PyTorch

        run_command()
