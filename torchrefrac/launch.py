"""Starts the command line in a process that shares its processors well."""

import os


def main() -> None:
    """Entry point of the `torchrefrac` command.

    OpenMP's threads wait by spinning unless told otherwise before PyTorch is loaded. Beside one other busy process that
    makes a run several times slower, for nothing in return: its many small operations hardly profit from spinning.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from torchrefrac.cli import main as run_command  # noqa: PLC0415 - loads PyTorch

    run_command()
