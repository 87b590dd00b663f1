"""Which pixels of photographs may be used, by any stage: masks beside the images, and the alpha of the images."""

from functools import cached_property
from pathlib import Path

import cv2
import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.files.photographs import check_photograph, read_alpha
from torchrefrac.scene.capture import Capture, CaptureError

IMAGES, MASKS = "images", "masks"
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


class Masks:
    """The masks of a capture in masks/ beside images/, and what its images themselves say to be transparent.

    masks/NAME.png, where NAME is that of the image with or without its ending. What is black there, or wholly
    transparent, is used by no stage. Raises CaptureError where an image has two masks.
    """

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self.paths = [_mask_of(capture.folder / MASKS, name) for name in capture.names]

    @cached_property
    def hide_something(self) -> bool:
        """Whether any image has pixels that may not be used."""
        return any(self.used(image) is not None for image in range(len(self.paths)))

    def check(self) -> None:
        """Raise CaptureError for a mask that fits no image, cannot be read, or has another size than the images.

        Masks of photographs that are not listed are no mistake where these lie among the images, or where all that are
        listed have masks.
        """
        folder = self._capture.folder / MASKS
        unknown = _pictures(folder) - set(self.paths) if None in self.paths else set[Path]()
        if unknown:
            images = self._capture.photographs_folder
            others = (path.relative_to(images).as_posix() for path in _pictures(images))
            unknown -= {place for name in others for place in _places(folder, name)}
        if unknown:
            name = self._capture.names[self.paths.index(None)]
            wanted = " or ".join(str(place) for place in _places(Path(MASKS), name))
            raise CaptureError(f"{min(unknown)} fits no image of capture.json; that of {name} must be {wanted}")
        for image, path in enumerate(self.paths):
            if path is not None:
                check_photograph(path)
                self._read(path, image)

    def used(self, image: int) -> Bool[Tensor, "height width"] | None:
        """Which pixels of an image may be used; None where all may.

        Raises CaptureError for a mask that cannot be read or has another size than the images.
        """
        mask = self.paths[image]
        used = None if mask is None else self._read(mask, image)
        alpha = read_alpha(self._capture.paths[image])
        if alpha is not None:
            opaque = self._sized(torch.from_numpy(alpha > 0), self._capture.paths[image], image)
            used = opaque if used is None else used & opaque
        return None if used is None or bool(used.all()) else used

    def _read(self, path: Path, image: int) -> Bool[Tensor, "height width"]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            raise CaptureError(f"{path} cannot be read as an image; is it a complete PNG file?")
        return self._sized(torch.from_numpy(picture > 0), path, image)

    def _sized(self, picture: Bool[Tensor, "rows columns"], path: Path, image: int) -> Bool[Tensor, "rows columns"]:
        camera = self._capture.cameras[int(self._capture.camera[image])]
        if tuple(picture.shape) != (camera.height, camera.width):
            found, wanted = "x".join(map(str, reversed(picture.shape))), f"{camera.width}x{camera.height}"
            raise CaptureError(f"{path} is {found}, but the images are {wanted}; give it their size")
        return picture


def _mask_of(folder: Path, name: str) -> Path | None:
    found = [place for place in _places(folder, name) if place.is_file()]
    if len(found) > 1:
        raise CaptureError(f"{name} has two masks, {found[0]} and {found[1].name}; delete the one that is wrong")
    return found[0] if found else None


def _places(folder: Path, name: str) -> tuple[Path, ...]:
    """Where the mask of an image may lie."""
    return tuple(dict.fromkeys((folder / f"{name}.png", (folder / name).with_suffix(".png"))))


def _pictures(folder: Path) -> set[Path]:
    """The pictures in a folder and those below it; none where there is no folder."""
    return {path for path in folder.rglob("*") if path.suffix.lower() in PICTURES and not path.name.startswith(".")}
