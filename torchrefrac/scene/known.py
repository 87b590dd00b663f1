"""Points whose places are known, as the corners of a board."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from torchrefrac.scene.tables import Observations


@dataclass(frozen=True, eq=False)
class KnownPoints:
    """Places in a frame of their own, and where they are seen."""

    points: Float[Tensor, "n 3"]
    observations: Observations
