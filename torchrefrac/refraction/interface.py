"""The flat layers between camera and scene."""

from collections.abc import Callable, Sequence
from dataclasses import InitVar, dataclass, field, replace
from functools import reduce
from operator import or_
from typing import Any

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchrefrac.checks import holds_everywhere, require, require_broadcasting, require_floating
from torchrefrac.geometry import Plane
from torchrefrac.geometry.triples import Part, Vectors
from torchrefrac.numerics import like, pick
from torchrefrac.refraction.water import FRESH_WATER

GLASS = 1.52
Number = Part | float
Parameter = Float[Tensor, "..."]  # a part or vectors
Unchecked = Shaped[Tensor, "..."] | float


def _water_level() -> Plane:
    """z = 0; a function, because the compiler does not trace a class as a default factory."""
    return Plane()


@dataclass(frozen=True, eq=False)
class FlatInterface:
    """Flat, parallel layers between a camera and what it looks at: a water surface, a wall of glass, a port, a slab.

    `plane` is the first surface that a ray from the camera meets, its normal pointing to the camera's side; by
    default z = 0 with the camera above. Points on the camera's side, and on that surface, are seen straight.

    Two media: index_ratio = n_water / n_air, at least 1, the camera in the rarer. 1 is no interface at all. Any media:
    `layers`, refractive indices of at least 1 from the camera's medium to the last one, of which only the ratios
    matter, with the `thickness` (length unit of the scene) of each layer between the first and the last: (1.0, 1.52,
    1.333) with (0.01,) is an aquarium wall, (1.333, 1.0) a diver who looks out. `index_ratio` then is last / first.

    moves_with_camera: the plane is fixed to the camera and given in its frame (x right, y down, z forward), as for a
    flat port. Each value is a number or a tensor that broadcasts against the camera's batch. Raises ValueError,
    naming the argument, for an index below 1, a negative thickness, or values that are not finite. check=False is for
    copies of what has been checked.
    """

    index_ratio: Number | None = None
    layers: Sequence[Number] | Float[Tensor, "*#batch layers"] | None = None
    thickness: Sequence[Number] | Float[Tensor, "*#batch inner"] = ()
    plane: Plane = field(default_factory=_water_level)
    moves_with_camera: bool = False
    check: InitVar[bool] = True

    def __post_init__(self, check: bool) -> None:
        if not check:
            return
        layers = None if self.layers is None else _tuple_of(self.layers)
        if layers is None:
            index_ratio = FRESH_WATER if self.index_ratio is None else self.index_ratio
            _require_all((index_ratio,), "index_ratio", at_least=1.0)
        elif len(layers) < 2:
            raise ValueError(f"layers has length {len(layers)}, but must have at least 2: the camera's and the last")
        else:
            _require_all(layers, "layers", at_least=1.0)
            index_ratio = layers[-1] / layers[0]
            given = self.index_ratio
            if given is not None and not holds_everywhere(torch.as_tensor(given) == torch.as_tensor(index_ratio)):
                raise ValueError("index_ratio and layers disagree, but only one of them must be given")
        thickness, wanted = _tuple_of(self.thickness), 0 if layers is None else len(layers) - 2
        if len(thickness) != wanted:
            raise ValueError(f"thickness has length {len(thickness)}, but must have {wanted}: of layers between others")
        _require_all(thickness, "thickness", at_least=0.0)
        for name, value in (("index_ratio", index_ratio), ("layers", layers), ("thickness", thickness)):
            object.__setattr__(self, name, value)
        _ = self.shape

    @classmethod
    def glass_wall(
        cls,
        plane: Plane,
        glass_thickness: Number,
        index_ratio: Number = FRESH_WATER,
        glass_index: Number = GLASS,
        moves_with_camera: bool = False,
    ) -> "FlatInterface":
        """Air, glass, water: an aquarium seen through its wall. `plane` is the dry face of the glass."""
        layers, thickness = (1.0, glass_index, index_ratio), (glass_thickness,)
        return cls(layers=layers, thickness=thickness, plane=plane, moves_with_camera=moves_with_camera)

    @classmethod
    def flat_port(
        cls, distance: float, glass_thickness: Number, index_ratio: Number = FRESH_WATER, glass_index: Number = GLASS
    ) -> "FlatInterface":
        """The port of an underwater housing, `distance` ahead of the camera's centre and square to its axis."""
        facing = Plane((0.0, 0.0, -1.0), -distance)
        return cls.glass_wall(facing, glass_thickness, index_ratio, glass_index, moves_with_camera=True)

    @classmethod
    def slab(cls, plane: Plane, thickness: Number, index_ratio: Number = FRESH_WATER) -> "FlatInterface":
        """A plate of the denser medium with air on both sides, such as a window pane or a thin cuvette."""
        return cls(layers=(1.0, index_ratio, 1.0), thickness=(thickness,), plane=plane)

    @property
    def indices(self) -> tuple[Number, ...]:
        """Refractive index of every layer, the camera's first."""
        if self.layers is None:
            assert self.index_ratio is not None
            return 1.0, self.index_ratio
        assert isinstance(self.layers, tuple)
        return self.layers

    @property
    def is_absent(self) -> bool:
        """Whether it is known without a look at tensors that there is nothing to refract."""
        first = self.indices[0]
        return isinstance(first, float | int) and all(isinstance(n, float | int) and n == first for n in self.indices)

    @property
    def camera_in_rarest(self) -> bool:
        """Whether it is known without a look at tensors that no medium is rarer than the camera's."""
        first = self.indices[0]
        if isinstance(first, float | int) and first == 1.0:  # no index is below 1
            return True
        numbers = [float(n) for n in self.indices if not isinstance(n, Tensor)]
        return len(numbers) == len(self.indices) and numbers[0] == min(numbers)

    def parameters(self, reference: Float[Tensor, "..."]) -> list[Parameter]:
        """Unit normal, offset, the index of each layer and the thickness of those between the first and the last, in
        the dtype and on the device of `reference`."""
        numbers = (self.plane.offset, *self.indices, *self.thickness)
        return [self.plane.normal_like(reference), *(like(value, reference) for value in numbers)]

    def with_index_ratio(self, index_ratio: Number) -> "FlatInterface":
        """The same with another last medium: its index is `index_ratio` times that of the camera's."""
        if self.layers is None:
            return replace(self, index_ratio=index_ratio)
        return replace(self, index_ratio=None, layers=(*self.indices[:-1], index_ratio * self.indices[0]))

    def refracts(self) -> Bool[Tensor, "*batch"]:
        """Mask: False where all media have the same index."""
        first, *others = self.indices
        return torch.as_tensor(reduce(or_, (index != first for index in others)))

    def index_like(self, reference: Float[Tensor, "..."]) -> Float[Tensor, "*batch"]:
        """The index ratio in the dtype and on the device of `reference`."""
        assert self.index_ratio is not None
        return like(self.index_ratio, reference)

    @property
    def shape(self) -> torch.Size:
        """The batch shape *B."""
        numbers = {"indices": self.indices, "thickness": self.thickness}
        shapes = {f"{k}[{i}]": n.shape for k, v in numbers.items() for i, n in enumerate(v) if isinstance(n, Tensor)}
        return require_broadcasting(plane=self.plane.shape, **shapes)

    def indexed(self, index: Any, batch: Sequence[int]) -> "FlatInterface":
        """Those of some of the cameras of a batch (see `RefractiveCamera.__getitem__`)."""
        return self._with_each(lambda value: pick(value, index, batch), self.plane.indexed(index, batch))

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "FlatInterface":
        """The same in another dtype or on another device; numbers fit any."""

        def moved(value: Number) -> Number:
            return value.to(dtype=dtype, device=device) if isinstance(value, Tensor) else value

        return self._with_each(moved, self.plane.to(dtype=dtype, device=device))

    def _with_each(self, change: Callable[[Any], Any], plane: Plane) -> "FlatInterface":
        layers = None if self.layers is None else tuple(change(n) for n in self.indices)
        ratio = change(self.index_ratio) if layers is None else layers[-1] / layers[0]
        thickness = tuple(change(d) for d in self.thickness)
        return FlatInterface(ratio, layers, thickness, plane, self.moves_with_camera, check=False)


def parameter_dims(parameters: Sequence[Parameter]) -> tuple[int, ...]:
    """How many dimensions of each of `FlatInterface.parameters` belong to one element: the normal's components."""
    return 1, *(0 for _ in parameters[1:])


def split_parameters(parameters: Sequence[Parameter]) -> tuple[Vectors, Part, Sequence[Part], Sequence[Part]]:
    """Normal, offset, indices and thickness out of the list that `FlatInterface.parameters` gave."""
    normal, offset, *layers = parameters
    count = len(layers) // 2 + 1
    return normal, offset, layers[:count], layers[count:]


def _tuple_of(values: Sequence[Unchecked] | Shaped[Tensor, "*batch n"]) -> tuple[Unchecked, ...]:
    return values.unbind(dim=-1) if isinstance(values, Tensor) else tuple(values)


def _require_all(values: Sequence[Unchecked], name: str, at_least: float) -> None:
    for value in values:
        require_floating(value, name)
        require(value, name, at_least=at_least)
