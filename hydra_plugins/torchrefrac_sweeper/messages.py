"""What goes wrong, also what Hydra says in several lines, as one sentence."""

from pathlib import Path
from typing import Any

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from torchrefrac.sweeps.folder import file_sentence

COMPOSITION_ERRORS = (HydraException, OmegaConfBaseException)
NOISE = (
    "Error parsing override", "See http", "Config search path", "provider=", "full_key:", "object_type=",
    "To append to",
)  # fmt: skip
LONGEST = 800  # characters that are still read


def one_sentence(error: BaseException, folder: Path | None = None) -> str:
    """Name the option or the file, what it got and what it could be.

    Any other error says what it says itself, on one line; one without words is named by its type. `folder` is where
    results go, for errors of files that do not say where they happened.
    """
    if isinstance(error, MissingConfigException):  # which is an OSError, too
        return _unknown_choice(error)
    if isinstance(error, HydraException | MissingMandatoryValue):
        return _composition(error)
    if isinstance(error, OSError) and error.errno is not None:
        return file_sentence(error, folder)
    words = _words(error) or type(error).__name__
    return f"there is not enough memory ({words})" if isinstance(error, MemoryError) else words


def _unknown_choice(error: MissingConfigException) -> str:
    group, _, choice = str(error.missing_cfg_file).rpartition("/")
    if not error.options:
        return _words(error)
    return f"{group} is {choice!r}, but must be one of {', '.join(sorted(error.options))}"


def _composition(error: HydraException | MissingMandatoryValue) -> str:
    words, cause = _words(error), error.__cause__
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} is missing; give it on the command line as {error.full_key}=VALUE"
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} is not understood ({words}); an option is given as NAME=VALUE"
    if words.startswith("Ambiguous value for argument"):
        given = words.split("'")[1]
        return f"{given} has several values; add -m to run them one after the other, or [ ] to give them as a list"
    if isinstance(cause, ConfigKeyError | ConfigAttributeError):
        return f"{cause.full_key} is not an option{_known(cause.parent_node)}"
    if isinstance(cause, OmegaConfBaseException):
        return f"{words}: {_words(cause)}" if words else _words(cause)
    return words or type(error).__name__


def _known(parent: Any) -> str:
    if not isinstance(parent, DictConfig) or not len(parent):
        return ""
    return f"; known here are {', '.join(sorted(str(key) for key in parent if key != 'hydra'))}"


def _words(error: BaseException) -> str:
    lines = (line for line in str(error).splitlines() if not line.strip().startswith(NOISE))
    words = " ".join(" ".join(lines).split())
    return words if len(words) <= LONGEST else f"{words[:LONGEST]} ..."
