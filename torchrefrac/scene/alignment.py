"""An alignment: oriented images and the tie points between them, in whatever frame they were computed."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.checks import TorchrefracError
from torchrefrac.scene.reconstruction import Reconstruction


class AlignmentError(TorchrefracError, ValueError):
    """The alignment cannot be used; the message names the file and the record or field, and the remedy."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """m oriented images, n tie points and N observations; the frame is that of the file, in length_unit.

    names of the images; `lenses` (G), each unbatched, and lens (m), which of them each image has. rotation (m, 3, 3)
    cam_from_world, center (m, 3). points (n, 3), colors (n, 3) uint8. Observations: image (N), point (N) ascending,
    pixels (N, 2); a point has at most one in an image.

    Raises AlignmentError where shapes do not fit together, an index is out of range or `point` is not ascending.
    """

    names: tuple[str, ...]
    lenses: tuple[Intrinsics, ...]
    lens: Tensor
    rotation: Tensor
    center: Tensor
    points: Tensor
    colors: Tensor
    image: Tensor
    point: Tensor
    pixels: Tensor
    length_unit: str = "unit"

    def __post_init__(self) -> None:
        m, n, observations = len(self.names), len(self.points), len(self.image)
        shapes = {
            "lens": (m,),
            "rotation": (m, 3, 3),
            "center": (m, 3),
            "points": (n, 3),
            "colors": (n, 3),
            "image": (observations,),
            "point": (observations,),
            "pixels": (observations, 2),
        }
        for name, wanted in shapes.items():
            shape = tuple(getattr(self, name).shape)
            if shape != wanted:
                raise AlignmentError(
                    f"{name} has shape {shape}, but must have {wanted} with {m} images, {n} points and "
                    f"{observations} observations"
                )
        for i, intrinsics in enumerate(self.lenses):
            if intrinsics.shape != ():
                raise AlignmentError(
                    f"lenses[{i}] has batch shape {tuple(intrinsics.shape)}, but must be a single lens"
                )
        for name, count in (("lens", len(self.lenses)), ("image", m), ("point", n)):
            _require_index(getattr(self, name), name, count)
        if bool((self.point.diff() < 0).any()):
            raise AlignmentError("point is not ascending; sort the observations by point")

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def from_reconstruction(cls, reconstruction: Reconstruction) -> "Alignment":
        """Its registered images and the points that at least two of them see."""
        everything = cls(
            names=reconstruction.names,
            lenses=(reconstruction.intrinsics,),
            lens=torch.zeros_like(reconstruction.registered, dtype=torch.long),
            rotation=reconstruction.rotation,
            center=reconstruction.center,
            points=reconstruction.points,
            colors=reconstruction.colors,
            image=reconstruction.image,
            point=reconstruction.point,
            pixels=reconstruction.pixels,
            length_unit=reconstruction.length_unit,
        )
        return everything.of_images(reconstruction.registered).cleaned()

    def of_images(self, keep: Tensor) -> "Alignment":
        """Only the images where the mask `keep` (m) is True, and their observations; all points and lenses stay."""
        observed = keep[self.image]
        return replace(
            self,
            names=tuple(name for name, kept in zip(self.names, keep.tolist(), strict=True) if kept),
            lens=self.lens[keep],
            rotation=self.rotation[keep],
            center=self.center[keep],
            image=(keep.cumsum(dim=0) - 1)[self.image[observed]],
            point=self.point[observed],
            pixels=self.pixels[observed],
        )

    def cleaned(self) -> "Alignment":
        """Without repeated observations of a point in one image, of which the first stays, and then without the points
        that have fewer than two."""
        order = (self.point * len(self) + self.image).argsort(stable=True)
        repeats = (self.point[order].diff() == 0) & (self.image[order].diff() == 0)
        keep = torch.ones_like(self.image, dtype=torch.bool)
        keep[order[1:][repeats]] = False
        enough = torch.bincount(self.point[keep], minlength=len(self.points)) >= 2
        keep &= enough[self.point]
        return replace(
            self,
            points=self.points[enough],
            colors=self.colors[enough],
            image=self.image[keep],
            point=(enough.cumsum(dim=0) - 1)[self.point[keep]],
            pixels=self.pixels[keep],
        )


def _require_index(index: Tensor, name: str, count: int) -> None:
    """Refuse what does not count from 0 to `count` - 1."""
    if index.dtype != torch.long:
        raise AlignmentError(f"{name} has dtype {index.dtype}, but must be torch.long")
    if len(index) and not 0 <= int(index.min()) <= int(index.max()) < count:
        raise AlignmentError(
            f"{name} runs from {int(index.min())} to {int(index.max())}, but must lie in 0 to {count - 1}"
        )
