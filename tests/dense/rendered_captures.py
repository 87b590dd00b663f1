"""Rendered photographs as files, with the sparse scene that a dense reconstruction begins with."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import torch
from torch import Tensor

from tests.dense.rendered_scenes import Rendered
from torchrefrac.dense.images import Images
from torchrefrac.geometry import Rigid
from torchrefrac.recorder import Advance, SilentRecorder
from torchrefrac.scene import Cameras, Capture, Interfaces, Observations, Scene

EVERY = 12  # pixels from one sparse point to the next


class CountingRecorder(SilentRecorder):
    """Knows how many cells there were to be densified, and how many were reported as done."""

    total = done = 0

    @contextmanager
    def meter(self, total: int, description: str, unit: str) -> Iterator[Advance]:
        counts = description == "densifying"
        if counts:
            self.total = total

        def advance(count: int, text: str) -> None:
            self.done += count * counts

        yield advance


def write_capture(rendered: Rendered, folder: Path, names: Sequence[str] = ()) -> Capture:
    """The images as 8-bit PNG files under folder/images, or as `names`."""
    count = len(rendered.images)
    names = tuple(names) or tuple(f"{i}.png" for i in range(count))
    paths = tuple(folder / "images" / name for name in names)
    for path, image in zip(paths, rendered.images, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), image.round().clamp(0, 255).byte().numpy())
    return Capture(
        folder=folder,
        names=names,
        paths=paths,
        cameras=Cameras.of([rendered.cameras.intrinsics]),
        interfaces=Interfaces.level(_index_ratio(rendered)),
        down_in_cam=-rendered.cameras.cam_from_world_rotation[:, :, 2],
        down_sigma=torch.zeros(count, dtype=torch.float64),
        height=torch.zeros(count, dtype=torch.float64),
        has_height=torch.zeros(count, dtype=torch.bool),
        length_unit="cm",
    )


def write_mask(capture: Capture, name: str, allowed: Tensor) -> None:
    """masks/NAME: white where allowed (h, w), black elsewhere."""
    path = capture.folder / "masks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), (allowed.byte() * 255).numpy())


def _index_ratio(rendered: Rendered) -> float:
    ratio = rendered.cameras.interface.index_ratio
    assert ratio is not None
    return float(ratio)


def images_of(rendered: Rendered, folder: Path) -> Images:
    return Images(write_capture(rendered, folder))


def sparse_scene(rendered: Rendered, every: int = EVERY) -> Scene:
    """True poses; as points, what every twelfth pixel of every image shows, observed by all images that hold it."""
    step = slice(every // 2, None, every)
    points = rendered.points[:, step, step].reshape(-1, 3)
    pixels, seen = rendered.cameras[:, None].project(points, inside_image=True)
    point, view = seen.T.nonzero().unbind(dim=-1)
    return Scene.create(
        Rigid(rendered.cameras.cam_from_world_rotation, rendered.cameras.center_in_world),
        rendered.cameras.intrinsics,
        Interfaces.level(_index_ratio(rendered)),
        points,
        Observations(view, point, pixels[view, point]),
        names=[f"{i}.png" for i in range(len(rendered.images))],
        length_unit="cm",
    )


def photographed_scene(rendered: Rendered, folder: Path) -> Scene:
    """`sparse_scene` with its photographs, which are written under `folder`."""
    return replace(sparse_scene(rendered), capture=write_capture(rendered, folder))
