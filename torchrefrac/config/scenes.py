"""Which scene a run is about: a folder of photographs, or a scene to be made."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrefrac.config.build import OptionError, build
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.paths import real_path
from torchrefrac.recorder import Recorder
from torchrefrac.synthetic.library import made_scene
from torchrefrac.synthetic.options import SyntheticOptions
from torchrefrac.synthetic.scenes import SCENES


@dataclass(frozen=True)
class FolderOptions:
    """An embedded scene by name, or the capture in the folder `path`."""

    name: str
    path: str | None = None

    @property
    def label(self) -> str:
        """What reports call it."""
        return self.name if self.path is None else real_path(self.path).name


def build_scene(values: Mapping[str, Any], path: str = "scene") -> FolderOptions | SyntheticOptions:
    """The options of a scene: those of a made scene where `kind` says which, else those of a folder.

    Raises OptionError that names the option.
    """
    if "kind" not in values:
        return build(FolderOptions, values, path)
    others = dict(values)
    kind = others.pop("kind")
    if kind not in SCENES:
        raise OptionError(f"{path}.kind is {kind!r}, but must be one of {', '.join(SCENES)}")
    return build(SCENES[kind], others, path)


def scene_folder(scene: FolderOptions | SyntheticOptions, cache: str | None, recorder: Recorder) -> Path:
    """Where the capture of a scene lies. A made scene is rendered into `cache` unless it is there already.

    Raises CaptureError where an embedded scene is not known or a scene cannot be made.
    """
    if isinstance(scene, SyntheticOptions):
        return made_scene(scene, None if cache is None else Path(cache), recorder)
    return embedded_scene(scene.name) if scene.path is None else Path(scene.path)
