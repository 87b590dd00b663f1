"""Paths as people give them."""

import os
from pathlib import Path


def real_path(path: str | Path) -> Path:
    """The absolute path, with all links followed; those of a loop stay, for whoever opens them to name."""
    return Path(os.path.realpath(path))
