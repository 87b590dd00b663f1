"""Which command runs, and what its exit status is."""

import signal
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType

from hydra.core.utils import env_override

from hydra_plugins.torchrefrac_sweeper.messages import COMPOSITION_ERRORS
from torchrefrac.cli.arguments import for_hydra, typed
from torchrefrac.cli.clouds import correct, export, triangulate
from torchrefrac.cli.commands import adjust, densify, reconstruct
from torchrefrac.cli.failures import failed, tell
from torchrefrac.cli.importing import calibrate, import_
from torchrefrac.config import OptionError
from torchrefrac.sweeps.folder import SweepError

INTERRUPTED = 130
TOO_LONG = "integer string conversion"  # what Python says of whole numbers of thousands of digits
OTHERS: dict[str, Callable[[], None]] = {
    "adjust": adjust, "calibrate": calibrate, "correct": correct, "densify": densify, "export": export,
    "import": import_, "triangulate": triangulate,
}  # fmt: skip


def main() -> None:
    """Run the command that is in sys.argv; exits with 1 where a job failed, 130 where it was interrupted."""
    failed.clear()
    typed[:] = sys.argv[1:]
    program, given = sys.argv[0], for_hydra(typed)
    command = OTHERS.get(given[0]) if given else None
    sys.argv = [program, *given] if command is None else [program, *given[1:]]  # what is left is Hydra's
    try:
        with _terminated_as_interrupted(), env_override({"HYDRA_FULL_ERROR": "1"}):  # else Hydra prints many lines
            (command or reconstruct)()
    except KeyboardInterrupt:
        kept = "the run folder holds the files of the finished stages, or, where it was complete before, what it held"
        print(f"interrupted; {kept}", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except (*COMPOSITION_ERRORS, SweepError, OSError) as error:
        tell(error)
    except ValueError as error:
        if TOO_LONG not in str(error):
            raise
        tell(OptionError("a number on the command line has too many digits to be read; give one that is meant"))
    if failed:
        sys.exit(1)


@contextmanager
def _terminated_as_interrupted() -> Generator[None, None, None]:
    """SIGTERM, as of a queue whose time is up, ends a run in the same way as Ctrl-C."""
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
