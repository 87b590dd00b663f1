"""The tables of a scene: cameras, views and what was seen in them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import pad

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.numerics import detached

PLAIN, FISHEYE = "opencv", "fisheye"
COEFFICIENTS = 8
SIGMAS = ("focal_sigma", "principal_point_sigma", "distortion_sigma")
ONLY = "camera"
"""The name of a camera that nobody named, where there is no other."""


@dataclass(frozen=True, eq=False)
class Cameras:
    """A table of intrinsics (see `Intrinsics`), and the size of the images of each in pixels, (width, height).

    distortion: the coefficients that a camera has, then zeros; models: "opencv" or "fisheye". Expected errors of what
    is stated, as standard deviations, zero where it counts as exact: focal_sigma, of both focal lengths by the same
    factor, relative; principal_point_sigma, of each coordinate, pixels; distortion_sigma, of each coefficient. By
    default all models are "opencv", all is exact, and the names are numbers. read_as: what the models are called in the
    file that cameras were read from, if anybody may ask. stated: what the errors are expected of,
    where the numbers have been changed since; None: of these.
    """

    sizes: tuple[tuple[int, int], ...]
    focal: Float[Tensor, "g 2"]
    principal_point: Float[Tensor, "g 2"]
    distortion: Float[Tensor, "g k"]
    models: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    focal_sigma: Float[Tensor, " f"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    principal_point_sigma: Float[Tensor, " f"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    distortion_sigma: Float[Tensor, " f"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    read_as: tuple[str, ...] = ()
    stated: "Cameras | None" = None

    def __post_init__(self) -> None:
        count = len(self.sizes)
        object.__setattr__(self, "distortion", _padded(self.distortion))
        for name in SIGMAS:
            if len(getattr(self, name)) != count:
                object.__setattr__(self, name, getattr(self, name).new_zeros(count))
        if not self.models:
            object.__setattr__(self, "models", (PLAIN,) * count)
        if not self.names:
            object.__setattr__(self, "names", (ONLY,) if count == 1 else tuple(map(str, range(count))))

    @classmethod
    def of(cls, every: Iterable[Intrinsics], names: Sequence[str] = ()) -> "Cameras":
        """From single intrinsics. Raises ValueError where some are batched."""
        every = tuple(every)
        for i, one in enumerate(every):
            if one.shape != ():
                raise ValueError(f"intrinsics[{i}] has batch shape {tuple(one.shape)}, but must be those of one camera")
        if not every:
            return cls((), torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0, COEFFICIENTS))
        return cls(
            tuple((one.width, one.height) for one in every),
            torch.stack([one.focal for one in every]),
            torch.stack([one.principal_point for one in every]),
            torch.stack([_padded(one.distortion) for one in every]),
            tuple(PLAIN if one.fisheye is None or not bool(one.fisheye) else FISHEYE for one in every),
            tuple(names),
        )

    def __len__(self) -> int:
        return len(self.sizes)

    def __getitem__(self, camera: int) -> Intrinsics:
        """The intrinsics of one, with five coefficients of distortion, or eight where it has more."""
        focal, middle, distortion = self.focal[camera], self.principal_point[camera], self.distortion[camera]
        fisheye = self.fisheye[camera] if self.models[camera] == FISHEYE else None
        count = COEFFICIENTS if bool((distortion[5:] != 0.0).any()) else 5
        return Intrinsics(*self.sizes[camera], focal, middle, distortion[:count], fisheye, check=False)

    def of_views(self, camera: Any, coefficients: int = 0) -> Intrinsics:
        """The intrinsics of views with the cameras `camera` (*B) as a batch (*B); not batched where there is one camera
        for all. With as many coefficients of distortion as any camera needs: none, five or eight, and `coefficients` at
        least."""
        row, sizes = 0 if len(self) == 1 else camera, None
        width, height = (max(numbers) for numbers in zip(*self.sizes, strict=True))
        if len(set(self.sizes)) > 1:
            sizes = self.focal.new_tensor(self.sizes)[row]
            if sizes.dim() == 1:  # a single view, which is no batch
                (width, height), sizes = self.sizes[int(row)], None
        fisheye = self.fisheye[row] if FISHEYE in self.models else None
        distortion = self.distortion[row][..., : max(coefficients, self.coefficients)]
        return Intrinsics(
            width, height, self.focal[row], self.principal_point[row], distortion, fisheye, sizes, check=False
        )

    def label(self, camera: int) -> str:
        """Of which camera something is, where there are several."""
        return f" of {self.names[camera]}" if len(self) > 1 else ""

    def sigma_of(self, name: str) -> Float[Tensor, " g"]:
        """Expected errors of "focal", "principal_point", or "distortion"."""
        return getattr(self, f"{name}_sigma")

    @property
    def are_uncertain(self) -> bool:
        """Whether anything stated of any camera is expected to err."""
        return any(bool((getattr(self, name) > 0.0).any()) for name in SIGMAS)

    @cached_property
    def fisheye(self) -> Bool[Tensor, " g"]:
        """Which of them are fisheyes."""
        return torch.tensor([model == FISHEYE for model in self.models], device=self.focal.device)

    @cached_property
    def coefficients(self) -> int:
        """How many coefficients of distortion any camera needs: none, five or eight; eight where somebody wants
        derivatives in them."""
        if self.distortion.requires_grad or bool((self.distortion[:, 5:] != 0.0).any()):
            return COEFFICIENTS
        return 5 if FISHEYE in self.models or bool((self.distortion != 0.0).any()) else 0

    def moved(
        self,
        focal: Float[Tensor, "g 2"],
        principal_point: Float[Tensor, "g 2"],
        distortion: Float[Tensor, "g 8"],
        coefficients: int,
    ) -> "Cameras":
        """With other numbers, of which so many `coefficients` of distortion, or as many as before, may differ from
        zero: nothing has to wait for a look at them."""
        numbers = {"focal": focal, "principal_point": principal_point, "distortion": distortion}
        moved = replace(self, **numbers, stated=self.stated or self)
        moved.__dict__["coefficients"] = max(coefficients, self.coefficients)
        return moved

    def exact(self) -> "Cameras":
        """The same without doubt: nothing of them varies in an adjustment by itself."""
        if not self.are_uncertain and self.stated is None:
            return self
        return replace(self, stated=None, **{name: torch.zeros_like(getattr(self, name)) for name in SIGMAS})

    def detached(self) -> "Cameras":
        """The same without a graph."""
        return detached(self)


def _padded(distortion: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch 8"]:
    """Coefficients of distortion, then zeros."""
    missing = COEFFICIENTS - distortion.shape[-1]
    return pad(distortion, (0, missing)) if missing else distortion


@dataclass(frozen=True, eq=False)
class Views:
    """A table of photographs by their names.

    pose: `cam_from_world`, meaningless where not registered, lengths in the unit of the scene. camera and interface:
    rows of the scene's tables.
    """

    names: tuple[str, ...]
    pose: Rigid
    camera: Int[Tensor, " m"]
    interface: Int[Tensor, " m"]
    registered: Bool[Tensor, " m"]

    @classmethod
    def posed(
        cls,
        pose: Rigid,
        names: Sequence[str] | None = None,
        camera: Int[Tensor, " m"] | None = None,
        interface: Int[Tensor, " m"] | None = None,
    ) -> "Views":
        """Registered views; by default with the names "0", "1" ..., the first camera and the first interface."""
        count, none = len(pose), torch.zeros(len(pose), dtype=torch.long, device=pose.center.device)
        return cls(
            tuple(map(str, range(count))) if names is None else tuple(names),
            pose,
            none if camera is None else camera,
            none if interface is None else interface,
            torch.ones(count, dtype=torch.bool, device=pose.center.device),
        )

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, view: Int[Tensor, " k"]) -> "Views":
        """Some of them, by their numbers."""
        names = tuple(self.names[i] for i in view.tolist())
        return Views(names, self.pose[view], self.camera[view], self.interface[view], self.registered[view])

    @property
    def rotation(self) -> Float[Tensor, "m 3 3"]:
        """Rotations cam_from_world."""
        return self.pose.rotation

    @property
    def center(self) -> Float[Tensor, "m 3"]:
        """Where the cameras stand in the world."""
        return self.pose.center

    @property
    def num_registered(self) -> int:
        """How many poses are known."""
        return int(self.registered.sum())

    def at(
        self, rotation: Float[Tensor, "k 3 3"], center: Float[Tensor, "k 3"], view: Int[Tensor, " k"] | None = None
    ) -> "Views":
        """Views `view`, by default all, registered at these poses."""
        if view is None:
            return replace(self, pose=Rigid(rotation, center), registered=torch.ones_like(self.registered))
        pose = Rigid(self.rotation.index_copy(0, view, rotation), self.center.index_copy(0, view, center))
        return replace(self, pose=pose, registered=self.registered.index_fill(0, view, True))


@dataclass(frozen=True, eq=False)
class Observations:
    """Points `point` seen in views `view` at `pixels`, each point at most once in a view.

    Those of one point are its track. Where they are part of a `Scene`, `point` ascends. weight: of each squared
    residual, by default 1. noise: how large errors of the pixels are expected to be, relative to each other, by default
    1; losses are of errors over noise.
    """

    view: Int[Tensor, " k"]
    point: Int[Tensor, " k"]
    pixels: Float[Tensor, "k 2"]
    weight: Float[Tensor, " k"] | None = None
    noise: Float[Tensor, " k"] | None = None

    @classmethod
    def none(cls) -> "Observations":
        """Nothing was seen."""
        index = torch.zeros(0, dtype=torch.long)
        return cls(index, index, torch.zeros(0, 2, dtype=torch.float64))

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, rows: Shaped[Tensor, " j"] | slice) -> "Observations":
        """Some of them, by a mask or by their numbers."""
        weight, noise = (None if values is None else values[rows] for values in (self.weight, self.noise))
        return Observations(self.view[rows], self.point[rows], self.pixels[rows], weight, noise)

    @property
    def weights(self) -> Float[Tensor, " k"]:
        """The weight of each observation: 1 by default."""
        return torch.ones_like(self.pixels[:, 0]) if self.weight is None else self.weight

    @property
    def precision(self) -> Float[Tensor, "*k"]:
        """1 / noise, or 1 for all."""
        return self.pixels.new_ones(()) if self.noise is None else 1.0 / self.noise

    def detached(self) -> "Observations":
        """The same without a graph."""
        return detached(self)
