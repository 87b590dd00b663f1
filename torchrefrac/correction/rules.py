"""How apparent points are corrected."""

from dataclasses import dataclass
from typing import Literal

from torchrefrac.checks import Range, require_ranges
from torchrefrac.scene.interfaces import MAX_INDEX_RATIO

Method = Literal["rays", "mean"]


@dataclass(frozen=True, kw_only=True)
class CorrectionRules:
    """method: "rays" meets the refracted rays of all cameras in one point; "mean" keeps x and y, and takes the mean of
    the depths that single cameras give (Dietrich 2017).

    index_ratio: n_water / n_air. max_angle_deg: between the vertical and the ray in air of a camera that counts;
    max_distance: from a camera to a point, horizontally (None: any). min_views: of cameras that a point is corrected
    by. angle_sigma_deg: standard deviation of the direction in which a camera sees a point. Raises ValueError for
    numbers that make no sense.
    """

    method: Method = "rays"
    index_ratio: float = 1.333
    max_angle_deg: float = 60.0
    max_distance: float | None = None
    min_views: int = 2
    angle_sigma_deg: float = 0.01

    def __post_init__(self) -> None:
        require_ranges(
            self,
            {
                "index_ratio": Range(at_least=1.0, at_most=MAX_INDEX_RATIO),
                "max_angle_deg": Range(above=0.0, at_most=89.0),
                "max_distance": Range(above=0.0, at_most=1e9),
                "min_views": Range(at_least=1, at_most=10_000),
                "angle_sigma_deg": Range(above=0.0, at_most=10.0),
            },
        )
        if self.method == "rays" and self.min_views < 2:
            raise ValueError(f"min_views is {self.min_views}, but rays meet where there are 2 or more; or method=mean")
