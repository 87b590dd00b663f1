"""Finished views of a dense reconstruction, stored so that an interrupted one goes on where it stopped."""

from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.atomic import remove_unfinished, replacing
from torchrefrac.dense.images import photographs
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Patches
from torchrefrac.files.fingerprint import fingerprint_of
from torchrefrac.files.mapped import mapped
from torchrefrac.files.masks import MASKS
from torchrefrac.files.npz import read_arrays, write_arrays
from torchrefrac.files.work import DamagedPartError
from torchrefrac.scene import Capture, Scene
from torchrefrac.scene.interfaces import TENSORS

ARRAYS = {
    **{"reference": "i:n", "pixels": "f:n2", "points": "f:n3", "normals": "f:n3", "sigma": "f:n", "footprint": "f:n"},
    **{"score": "f:n", "others": "i:nv", "visible": "b:nv"},
}
"""Of patches, as `read_arrays` takes them."""


class Store(Protocol):
    """Where the patches of finished views lie."""

    def load(self, image: int) -> Patches | None: ...

    def save(self, image: int, patches: Patches) -> None: ...

    def room(self, count: int, views: int) -> Patches:
        """Room for so many patches, compared with so many others, that need not lie in memory."""
        ...


class NoStore:
    """Stores nothing."""

    def load(self, image: int) -> Patches | None:
        return None

    def save(self, image: int, patches: Patches) -> None: ...

    def room(self, count: int, views: int) -> Patches:
        return Patches.room(count, views)


class FolderStore:
    """Stores them in a folder, one file a view, with what they were made from; others that lie there are removed, and
    damaged ones are not there."""

    def __init__(self, folder: Path, scene: Scene, options: DenseOptions) -> None:
        self.folder = folder
        made_from = fingerprint(scene, options)
        label = folder / "made_from.txt"
        if not label.is_file() or label.read_bytes() != made_from.encode("ascii"):
            self.clear()
            with replacing(label) as temporary:
                temporary.write_text(made_from, encoding="ascii")

    def load(self, image: int) -> Patches | None:
        path = self._path(image)
        if not path.is_file():
            return None
        try:
            found = read_arrays(path, ARRAYS, DamagedPartError)
        except DamagedPartError:
            return None
        return Patches(*(torch.from_numpy(found[name]) for name in ARRAYS))

    def save(self, image: int, patches: Patches) -> None:
        write_arrays({name: getattr(patches, name).numpy() for name in ARRAYS}, self._path(image))

    def room(self, count: int, views: int) -> Patches:
        return Patches.room(count, views, partial(mapped, folder=self.folder))

    def clear(self) -> None:
        """Remove all files, and the folder."""
        remove_unfinished(self.folder)
        for path in (*self.folder.glob("patches_*.npz"), self.folder / "made_from.txt"):
            path.unlink(missing_ok=True)
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _path(self, image: int) -> Path:
        return self.folder / f"patches_{image:05d}.npz"


class CountingStore:
    """Counts the patches that pass through to another store and back."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._new = self._old = self._images = 0

    def load(self, image: int) -> Patches | None:
        patches = self._store.load(image)
        if patches is not None:
            self._old, self._images = self._old + len(patches), self._images + 1
        return patches

    def save(self, image: int, patches: Patches) -> None:
        self._new += len(patches)
        self._store.save(image, patches)

    def room(self, count: int, views: int) -> Patches:
        return self._store.room(count, views)

    def metrics(self, seconds: float) -> dict[str, Any]:
        """How many patches there were before any was filtered out, and how fast they were found."""
        found: dict[str, Any] = {"dense_patches": self._old + self._new}
        if self._new:
            found["dense_patches_per_s"] = round(self._new / seconds, 1)
        if self._images:
            found["dense_images_resumed"] = self._images
        return found


def _drawn(capture: Capture) -> list[Float[Tensor, "..."]]:
    """Where the water ends in the photographs."""
    extent = capture.water_extent
    return [] if extent is None else [corners for corners in extent.in_images if corners is not None]


def fingerprint(scene: Scene, options: DenseOptions) -> str:
    """That of all that decides the patches: poses, intrinsics, water, points, options, image files and masks."""
    views, cameras, interfaces, seen = scene.views, scene.cameras, scene.interfaces, scene.observations
    capture = photographs(scene)
    return fingerprint_of(
        options,
        (views.registered, views.rotation, views.center, views.camera),
        (scene.points, scene.dry, seen.view, seen.point, seen.pixels),
        (cameras.focal, cameras.principal_point, cameras.distortion, cameras.sizes, cameras.models),
        [getattr(interfaces, name) for name in TENSORS],
        _drawn(capture),
        capture.paths,
        sorted((capture.folder / MASKS).glob("**/*.png")),
    )
