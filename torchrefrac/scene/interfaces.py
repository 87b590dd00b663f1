"""Interfaces: the flat layers through which views look."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.geometry import Plane
from torchrefrac.numerics import detached, like
from torchrefrac.refraction import FlatInterface
from torchrefrac.refraction.interface import GLASS

Kind = Literal["surface", "wall", "port"]
SURFACE: Kind = "surface"
WALL: Kind = "wall"
PORT: Kind = "port"
KINDS: tuple[Kind, ...] = (SURFACE, WALL, PORT)
"""Water that is open above; a wall, fixed in the world, as of an aquarium; the port of a housing, which moves with the
camera: its plane is in the frame of the camera then."""
NO_THICKNESS = 1e-12
"""Of a layer that is there, but does nothing."""
MAX_INDEX_RATIO = 3.0  # beyond any liquid
INDEX_RATIO_RANGE = f"n_water / n_air lies between 1 and {MAX_INDEX_RATIO:g} (water: 1.333)"


def _none() -> Float[Tensor, "0 0"]:
    return torch.zeros(0, 0, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Interfaces:
    """A table of first surfaces normal . x = offset in the world frame, with unit normals towards the cameras, and what
    lies beyond: index_ratio is n_water / n_air.

    Between air and water there may be `layers`, as of glass: their indices n / n_air, and their thickness in the unit
    of the scene; an interface with fewer of them than others has some of thickness 0. By default there are none.
    kinds: what each is, see KINDS; by default surfaces of water. sigmas: how uncertain what is stated is, by names of
    unknowns of an adjustment ("index_ratio", "layer_index", "layer_thickness", "plane_tilt" in radians,
    "plane_height"), which then vary, or "upright", in radians, of walls. stated: what is uncertain by that, where the
    numbers have been changed since; None: these.
    """

    normal: Float[Tensor, "e 3"]
    offset: Float[Tensor, " e"]
    index_ratio: Float[Tensor, " e"]
    layers: Float[Tensor, "e k"] = field(default_factory=_none)
    thickness: Float[Tensor, "e k"] = field(default_factory=_none)
    kinds: tuple[Kind, ...] = ()
    sigmas: Mapping[str, float] = field(default_factory=dict)
    stated: "Interfaces | None" = None

    def __post_init__(self) -> None:
        if not len(self.layers):
            nothing = self.offset.new_zeros(len(self.offset), 0)
            object.__setattr__(self, "layers", nothing)
            object.__setattr__(self, "thickness", nothing)
        if not self.kinds:
            object.__setattr__(self, "kinds", (SURFACE,) * len(self.offset))

    @classmethod
    def level(cls, index_ratio: float | Float[Tensor, ""], height: float = 0.0) -> "Interfaces":
        """One horizontal surface, by default at z = 0."""
        ratio = torch.as_tensor(index_ratio, dtype=torch.float64).reshape(1)
        normal = ratio.new_tensor(((0.0, 0.0, 1.0),))
        return cls(normal, ratio.new_full((1,), height), ratio)

    @classmethod
    def of_plane(cls, plane: Plane, index_ratio: float) -> "Interfaces":
        """One surface in any plane."""
        ratio = torch.tensor([index_ratio], dtype=torch.float64)
        return cls(plane.normal_like(ratio)[None], like(plane.offset, ratio).reshape(1), ratio)

    def __len__(self) -> int:
        return len(self.offset)

    @cached_property
    def is_level(self) -> bool:
        """Whether there is one first surface, the plane z = 0, of which nobody wants derivatives."""
        if self.move_with_camera or self.normal.requires_grad or self.offset.requires_grad:
            return False
        return self.normal.tolist() == [[0.0, 0.0, 1.0]] and self.offset.tolist() == [0.0]

    @property
    def are_horizontal(self) -> bool:
        """Whether all surfaces are level, at any height."""
        return all(normal == [0.0, 0.0, 1.0] for normal in self.normal.tolist())

    @cached_property
    def is_air(self) -> bool:
        """Whether there is one interface, at which nothing refracts, and nobody wants derivatives."""
        return not self.has_layers and not self.index_ratio.requires_grad and self.index_ratio.tolist() == [1.0]

    @property
    def are_possible(self) -> Bool[Tensor, ""]:
        """Whether no index is below 1 and no thickness below 0."""
        lowest = torch.cat((self.index_ratio, self.layers.flatten(), 1.0 + self.thickness.flatten()))
        return (lowest >= 1.0).all()

    @property
    def has_layers(self) -> bool:
        """Whether anything lies between air and water."""
        return self.layers.shape[-1] > 0

    @property
    def are_plain(self) -> bool:
        """Whether there is one surface, the plane z = 0, of water alone."""
        return len(self) == 1 and self.is_level and self.kinds == (SURFACE,) and not self.has_layers

    @property
    def move_with_camera(self) -> bool:
        """Whether they are ports."""
        return PORT in self.kinds

    def problem(self) -> str:
        """What cannot be right about the surfaces; empty where nothing is."""
        if not len(self):
            return "there must be at least one interface"
        if not (self.normal.norm(dim=-1) - 1.0).abs().max() < 1e-6 or not self.offset.isfinite().all():
            return "normal must hold unit vectors, and offset finite numbers"
        return self._problem_of_media()

    def _problem_of_media(self) -> str:
        wrong = self.index_ratio[~((self.index_ratio >= 1.0) & (self.index_ratio <= MAX_INDEX_RATIO))].tolist()
        if wrong:
            return f"index_ratio is {wrong[0]:g}, but {INDEX_RATIO_RANGE}"
        if not bool(((self.layers >= 1.0) & (self.layers <= MAX_INDEX_RATIO)).all()):
            return f"layers must have indices of 1 to {MAX_INDEX_RATIO:g}, relative to air (glass: 1.52)"
        if not bool(((self.thickness >= 0.0) & self.thickness.isfinite()).all()):
            return "thickness must be finite numbers of at least 0"
        mixed = self.move_with_camera and set(self.kinds) != {PORT}
        return "ports and other interfaces cannot be in one scene" if mixed else ""

    @property
    def planes(self) -> Plane:
        """All surfaces as a batch (e)."""
        return Plane(self.normal, self.offset, check=False)

    def heights(self, points: Float[Tensor, "*#batch 3"], interface: Any) -> Float[Tensor, "*batch"]:
        """Of points before the first surfaces of the interfaces `interface` (*B), negative beyond; -inf for ports,
        before which nothing is seen."""
        height = self.planes.indexed(interface, (len(self),)).signed_distance(points)
        return torch.full_like(height, -torch.inf) if self.move_with_camera else height

    def of_views(self, interface: Any, dry: Bool[Tensor, "*batch"] | None = None) -> FlatInterface:
        """What views with the interfaces `interface` (*B) look through, as a batch (*B); not batched where there is one
        for all. dry (*B): which of them look at something without water before it: their surface lies infinitely
        deep, so that nothing is beyond it."""
        if self.is_air:
            return FlatInterface(1.0)
        rows = 0 if len(self) == 1 else interface
        plane = Plane() if len(self) == 1 and self.is_level else self.planes.indexed(rows, (len(self),))
        if dry is not None:
            plane = Plane(plane.normal, without_water(self.offset[rows], dry), check=False)
        layers, thickness = self.layers[rows].unbind(dim=-1), self.thickness[rows].unbind(dim=-1)
        return layered(self.index_ratio[rows], layers, thickness, plane, self.move_with_camera)

    def refract(self) -> bool:
        """Whether any of them bends a ray."""
        return bool((self.index_ratio > 1.0).any())

    def lift(self) -> Float[Tensor, " e"]:
        """What the layers add to the height of a camera that sees water along their normal; it is negative for those
        that are denser than water (mathematics: T(m) at m = 0)."""
        return (self.thickness * (1.0 / self.layers - 1.0 / self.index_ratio[:, None])).sum(dim=-1)

    @property
    def stand_in_world(self) -> bool:
        """Whether rays are bent at planes that stand still, so that these show where the world is level to them."""
        return self.refract() and not self.move_with_camera

    def detached(self) -> "Interfaces":
        """The same without a graph."""
        return detached(self)

    @classmethod
    def joined(cls, every: "Sequence[Interfaces]") -> "Interfaces":
        """Several tables as one; what is uncertain of any is of all."""
        count = max(one.layers.shape[-1] for one in every)

        def padded(values: Float[Tensor, "e k"], by: float) -> Float[Tensor, "e wider"]:
            return torch.nn.functional.pad(values, (0, count - values.shape[-1]), value=by)

        return cls(
            normal=torch.cat([one.normal for one in every]),
            offset=torch.cat([one.offset for one in every]),
            index_ratio=torch.cat([one.index_ratio for one in every]),
            layers=torch.cat([padded(one.layers, 1.0) for one in every]),
            thickness=torch.cat([padded(one.thickness, 0.0) for one in every]),
            kinds=tuple(kind for one in every for kind in one.kinds),
            sigmas={name: sigma for one in every for name, sigma in one.sigmas.items()},
        )

    def moved(self, **tensors: Float[Tensor, "e *width"]) -> "Interfaces":
        """With other numbers than were stated."""
        return replace(self, **tensors, stated=self.stated or self)

    @property
    def may_have_glass(self) -> bool:
        """Whether there is a wall or port, with one layer before the water or none, where one may be missing."""
        return set(self.kinds) != {SURFACE} and self.layers.shape[-1] <= 1 and self.refract()

    def with_glass(self) -> "Interfaces":
        """The same with a layer of glass that is as good as none, where there is no layer."""
        if self.has_layers:
            return self
        none = torch.full_like(self.offset, NO_THICKNESS)[:, None]
        return replace(self, layers=torch.full_like(none, GLASS), thickness=none)

    def with_index_ratio(self, ratio: float) -> "Interfaces":
        """With another water; at a ratio of 1, which is that of a scene without refraction, without layers, too."""
        if ratio <= 1.0:
            return Interfaces.level(1.0).repeated(len(self))
        return replace(self, index_ratio=torch.full_like(self.index_ratio, ratio))

    def repeated(self, count: int) -> "Interfaces":
        """The one interface as many times."""
        tensors = {name: getattr(self, name).repeat(count, *(1,) * (getattr(self, name).dim() - 1)) for name in TENSORS}
        return replace(self, kinds=self.kinds * count, **tensors)

    def scaled(self, by: float | Float[Tensor, ""]) -> "Interfaces":
        """The same in another unit: lengths are so many times what they were."""
        stated = self.stated and self.stated.scaled(by)
        return replace(self, offset=by * self.offset, thickness=by * self.thickness, stated=stated)


TENSORS = ("normal", "offset", "index_ratio", "layers", "thickness")
"""The fields of `Interfaces` that are tensors."""


def layered(
    index_ratio: Float[Tensor, "*#batch"],
    layers: Sequence[Float[Tensor, "*#batch"]],
    thickness: Sequence[Float[Tensor, "*#batch"]],
    plane: Plane,
    moves_with_camera: bool = False,
) -> FlatInterface:
    """Air, layers, and water, of indices relative to air, not checked."""
    if not layers:
        return FlatInterface(index_ratio, plane=plane, moves_with_camera=moves_with_camera, check=False)
    media = (1.0, *layers, index_ratio)
    return FlatInterface(index_ratio, media, tuple(thickness), plane, moves_with_camera, check=False)


def without_water(offset: Float[Tensor, "*#batch"], dry: Bool[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
    """Offsets of surfaces, infinitely deep where it is dry: nothing lies beyond them then, and nothing depends on where
    they are."""
    return torch.where(dry, -torch.inf, offset)
