"""Photographs of a run as rays in two segments, for radiance fields and whatever else learns from pixels."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from torchrefrac.camera import RefractiveCamera
from torchrefrac.checks import require
from torchrefrac.commands.densify import open_run
from torchrefrac.dense.images import photographs
from torchrefrac.files.cameras import NamedCameras, named_cameras
from torchrefrac.learning.pixels import PixelTable
from torchrefrac.numerics import permuted

Split = Literal["train", "test", "all"]


class Rays(NamedTuple):
    """Rays of pixels, in the frame and the unit of the run.

    origin: the centre of the camera, in air; refrax: where the ray enters the last medium, as a rule the water;
    direction: unit vector from there on; color: red, green and blue, 0 to 1; mask: whether the ray enters the water and
    its pixel may be used; view: number of the photograph in `RefractiveRays.names`; pixel: x and y in the photograph,
    from the outer corner of its top left pixel. Where no ray enters the water, `refrax` is the origin; where the run
    knows of no refraction at all, it is, too, and `mask` is that of the pixel.
    """

    origin: Float[Tensor, "*n 3"]
    refrax: Float[Tensor, "*n 3"]
    direction: Float[Tensor, "*n 3"]
    color: Float[Tensor, "*n 3"]
    mask: Bool[Tensor, "*n"]
    view: Int[Tensor, "*n"]
    pixel: Float[Tensor, "*n 2"]

    def at(self, distance: Float[Tensor, "*n samples"]) -> Float[Tensor, "*n samples 3"]:
        """Points along the rays, so far from the refrax; in air, before it, where the distance is negative."""
        before = torch.nn.functional.normalize(self.refrax - self.origin, dim=-1)
        wet = self.refrax[..., None, :] + distance[..., None] * self.direction[..., None, :]
        dry = self.refrax[..., None, :] + distance[..., None] * before[..., None, :]
        return torch.where(distance[..., None] < 0.0, dry, wet)

    def to(self, device: torch.device | str) -> "Rays":
        """The same on another device."""
        return Rays(*(part.to(device, non_blocking=True) for part in self))


class RefractiveRays(Dataset[Rays]):
    """The photographs of a run as a data set of rays, each pixel one.

    Rays are cast as they are asked for, through what the run has found; colours come from a file that is mapped into
    memory (see `PixelTable`), so that photographs of any number can be learnt from, by several workers at a time.
    names, cameras: of the photographs of this split. dataset[5] is one ray, dataset[tensor] one for each number in it;
    `image` has those of a whole photograph, `loader` those of all in a random order. Lengths are in the unit of the
    run.

    run: folder of a run. split: "test" are the photographs that `holdout` names, or every so many-th in order of names,
    from the first on; "train" the others. smaller: whole number by which width and height are divided. capture: folder
    of the photographs, by default where the run says. cache: see `PixelTable`.

    Raises OptionError, SceneError or CaptureError where the run or its photographs are not there or do not belong
    together, and ValueError for a split without photographs.
    """

    def __init__(
        self,
        run: str | Path,
        split: Split = "train",
        *,
        holdout: int | Sequence[str] = 8,
        smaller: int = 1,
        capture: str | Path | None = None,
        cache: str | Path | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if split not in get_args(Split):
            raise ValueError(f"split is {split!r}, but must be one of {', '.join(get_args(Split))}")
        require(smaller, "smaller", at_least=1, at_most=64)
        scene = open_run(Path(run), None if capture is None else str(capture)).scene
        registered = scene.views.registered.nonzero()[:, 0].tolist()
        names = [scene.views.names[view] for view in registered]
        tested = set(sorted(names)[::holdout] if isinstance(holdout, int) else holdout)
        chosen = [i for i, name in enumerate(names) if split == "all" or (name in tested) == (split == "test")]
        if not chosen:
            raise ValueError(f"no photograph of {run} is of the split {split!r}; holdout is {holdout!r}")
        rows = [registered[i] for i in chosen]
        self.cameras = _quick(named_cameras(scene.of_views(_mask(len(scene.views), rows))))
        self.names = self.cameras.names
        self.dtype = dtype
        self._refracts = scene.interfaces.refract()
        self._table = PixelTable(photographs(scene).of_views(rows), smaller, None if cache is None else Path(cache))
        self._widths = torch.tensor([width for width, _ in self._table.sizes])
        self._smaller = smaller

    def __len__(self) -> int:
        """How many rays there are."""
        return len(self._table)

    def __getitem__(self, number: int | Int[Tensor, " n"]) -> Rays:
        """Of ray numbers, row by row, one photograph after the other."""
        if not isinstance(number, Tensor):
            if not -len(self) <= number < len(self):
                raise IndexError(f"ray {number} of {len(self)}")
            return Rays(*(part[0] for part in self[torch.tensor([number % len(self)])]))
        view = torch.searchsorted(self._table.starts, number, right=True) - 1
        width = self._widths[view]
        inside = number - self._table.starts[view]
        place = torch.stack((inside % width, inside // width), dim=-1)
        return self._rays(self.cameras[view], place, self._table[number], view)

    def image(self, view: int) -> Rays:
        """The rays of a whole photograph (height, width)."""
        width, height = self._table.sizes[view]
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        views = torch.full((height, width), view)
        return self._rays(self.cameras[view], torch.stack((x, y), dim=-1), self._table.image(view), views)

    def loader(
        self, batch: int = 4096, *, workers: int = 0, shuffle: bool = True, seed: int = 0, **options: Any
    ) -> DataLoader[Rays]:
        """Batches of rays, every ray once in each epoch, in another random order in each; the last may be smaller.
        options: others of `torch.utils.data.DataLoader`."""
        order = _Order(len(self), batch, seed if shuffle else None)
        return DataLoader(self, sampler=order, batch_size=None, num_workers=workers, **options)

    def _rays(
        self,
        camera: RefractiveCamera,
        place: Int[Tensor, "*n 2"],
        pixels: UInt8[Tensor, "*n 4"],
        view: Int[Tensor, "*n"],
    ) -> Rays:
        """Of pixels at a column and a row of the photograph as it is in the table."""
        pixel = (place + 0.5) * float(self._smaller)
        refrax, _, direction, bent = camera.follow_rays(pixel)
        used = pixels[..., 3] > 0
        origin = camera.center_in_world.expand_as(refrax)
        refrax = refrax if self._refracts else origin  # a plane that bends nothing may lie anywhere
        color = pixels[..., :3].to(self.dtype) / 255.0
        origin, refrax, direction, pixel = (part.to(self.dtype) for part in (origin, refrax, direction, pixel))
        return Rays(origin, refrax, direction, color, used & bent if self._refracts else used, view, pixel)


class _Order(Sampler[Int[Tensor, " batch"]]):
    """Numbers of rays, a batch at a time; with a seed those of each epoch in an order of its own."""

    def __init__(self, count: int, batch: int, seed: int | None) -> None:
        require(batch, "batch", at_least=1)
        self._count, self._batch, self._seed = count, batch, seed
        self._epoch = 0

    def __len__(self) -> int:
        return math.ceil(self._count / self._batch)

    def __iter__(self) -> Iterator[Int[Tensor, " batch"]]:
        epoch, self._epoch = self._epoch, self._epoch + 1
        for start in range(0, self._count, self._batch):
            numbers = torch.arange(start, min(start + self._batch, self._count))
            yield numbers if self._seed is None else permuted(numbers, self._count, 1_000_003 * self._seed + epoch)


def _quick(cameras: NamedCameras) -> NamedCameras:
    """The same without distortion where there is none."""
    return replace(cameras, intrinsics=cameras.intrinsics.without_idle_distortion(), check=False)


def _mask(count: int, rows: Sequence[int]) -> Bool[Tensor, " count"]:
    return torch.zeros(count, dtype=torch.bool).index_fill(0, torch.tensor(rows), True)
