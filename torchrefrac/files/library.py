"""Scenes whose photographs come with the package."""

from pathlib import Path

from torchrefrac.scene.capture import CaptureError

DATA = Path(__file__).resolve().parent.parent / "data"


def embedded_scene(name: str) -> Path:
    """Folder of the embedded scene `name`. Raises CaptureError, with the names of those there are, for another."""
    known = sorted(path.parent.name for path in DATA.glob("*/capture.json"))
    if name not in known:
        raise CaptureError(f"scene {name!r} does not come with the package; known are {', '.join(known)}")
    return DATA / name
