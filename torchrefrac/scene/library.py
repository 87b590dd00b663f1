"""Scenes that come with the package, as photographs or as what it takes to make them."""

import os
from pathlib import Path

from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene.capture import CaptureError
from torchrefrac.scene.synthetic.library import render_scene, scene_folder
from torchrefrac.scene.synthetic.options import SyntheticOptions
from torchrefrac.scene.synthetic.scenes import stage_of

DATA = Path(__file__).resolve().parent.parent / "data"


def embedded_scene(name: str) -> Path:
    """Folder of the embedded scene `name`."""
    known = sorted(path.parent.name for path in DATA.glob("*/capture.json"))
    if name not in known:
        raise CaptureError(f"scene {name!r} does not come with the package; known are {', '.join(known)}")
    return DATA / name


def made_scene(options: SyntheticOptions, cache: Path | None = None, recorder: Recorder | None = None) -> Path:
    """Folder of the scene that `options` describe, a capture with its truth; rendered unless `cache` has it already.

    By default `cache` is the folder of the environment variable TORCHREFRAC_CACHE, or torchrefrac/ in the user's cache.
    Raises SceneError, one sentence with the remedy, where the scene cannot be made or written.
    """
    cache = cache or default_cache()
    folder = scene_folder(options, cache)
    return folder if folder.is_dir() else render_scene(stage_of(options), options, cache, recorder or SilentRecorder())


def default_cache() -> Path:
    """Where made scenes are kept unless something else is said."""
    given = os.environ.get("TORCHREFRAC_CACHE")
    if given:
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrefrac"
