"""A scene that is ready to be photographed."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float, Float32
from torch import Tensor

from torchrefrac.geometry.surfaces import Surface
from torchrefrac.scene.capture import CaptureError

Texture = Callable[[Float[Tensor, "n 2"]], Float32[Tensor, "n 3"]]


class StageError(CaptureError):
    """A scene cannot be made; the message names the option and the remedy."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A surface with a name and its colours.

    `texture` maps texture coordinates to RGB from 0 to 255. is_plane: whether the
    paper's flatness can be measured on it.
    """

    name: str
    surface: Surface
    texture: Texture
    is_plane: bool = False


@dataclass(frozen=True, eq=False)
class Stage:
    """What a scene consists of, before any light.

    World: z up, the water surface z = 0, lengths in length_unit. rotation cam_from_world and center of the cameras
    along their path. Surfaces get their colours times `ambient` + `direct` * |normal . towards_light|. position_sigma:
    standard deviation of a coordinate of a camera's satellite position; None: there is none. background: grey value
    where a ray meets nothing. water_extent: corners of the water as seen from above; none: it is everywhere.
    """

    pieces: tuple[Piece, ...]
    rotation: Float[Tensor, "m 3 3"]
    center: Float[Tensor, "m 3"]
    length_unit: str
    towards_light: tuple[float, float, float] = (0.3, 0.2, 1.0)
    ambient: float = 1.0
    direct: float = 0.0
    position_sigma: float | None = None
    background: float = 128.0
    water_extent: tuple[tuple[float, float], ...] = ()
