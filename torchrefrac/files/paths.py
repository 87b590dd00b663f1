"""Paths as people give them."""

import os
from pathlib import Path


def real_path(path: str | Path) -> Path:
    """The absolute path, with all links followed; those of a loop stay, for whoever opens them to name."""
    return Path(os.path.realpath(path))


def user_cache() -> Path:
    """The folder of the environment variable TORCHREFRAC_CACHE, or torchrefrac/ in the user's cache."""
    given = os.environ.get("TORCHREFRAC_CACHE")
    return Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrefrac"
