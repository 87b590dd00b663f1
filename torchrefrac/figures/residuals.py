"""How well the points fit what the images show: by image, and by the angle at which the water was looked through."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.figures.plotting import ESTIMATE, PALE, SECOND, legend_above, legend_key, number_images, panels
from torchrefrac.scene import Scene

BINS, FEWEST = 24, 20
STEPS_DEG = (0.5, 1.0, 2.0, 2.5, 5.0)
NINETY = 0.9


@dataclass(frozen=True)
class Residuals:
    """Of observations: the image, reprojection error in pixels, and angle of incidence in degrees."""

    image: Int[Tensor, " n"]
    error: Float[Tensor, " n"]
    incidence: Float[Tensor, " n"]

    @classmethod
    def of(cls, scene: Scene) -> "Residuals":
        """Those of a reconstruction; observations that cannot be projected are left out."""
        error = scene.errors()
        angle, valid = scene.cameras_of(scene.observations).incidence_angle(scene.points[scene.observations.point])
        good = error.isfinite() & valid
        return cls(scene.observations.view[good], error[good], angle[good].rad2deg())

    def of_image(self, image: int) -> "Residuals":
        rows = self.image == image
        return Residuals(self.image[rows], self.error[rows], self.incidence[rows])

    def __len__(self) -> int:
        return len(self.error)


def by_image_figure(residuals: Residuals, registered: Bool[Tensor, " m"]) -> Any:
    """Median and 90 % bound of the reprojection error of each image."""
    from matplotlib.patches import Patch  # noqa: PLC0415 - slow to import

    count = len(registered)
    figure, ((panel,),) = panels(1, 1, 2.7)
    parts = {i + 1: error for i in range(count) if len(error := residuals.of_image(i).error)}
    numbers = list(parts)
    medians = [float(error.median()) for error in parts.values()]
    upper = [float(error.quantile(NINETY)) for error in parts.values()]
    panel.bar(numbers, medians, width=0.65, color=ESTIMATE)
    panel.vlines(numbers, medians, upper, color=SECOND, lw=1.4)
    panel.plot(numbers, upper, "_", color=SECOND, ms=9, mew=1.8)
    missing = [i + 1 for i in range(count) if not bool(registered[i])]
    handles = [Patch(color=ESTIMATE, label="median"), legend_key(color=SECOND, label="90 % are below")]
    if missing:
        panel.plot(missing, [0.0] * len(missing), "x", color="#000000", ms=7, clip_on=False, zorder=5)
        handles.append(legend_key(marker="x", ls="", color="#000000", label="not placed"))
    panel.grid(visible=False, axis="x")
    panel.set_ylabel("reprojection error (px)")
    panel.set_ylim(bottom=0.0)
    number_images(panel, count)
    legend_above(figure, handles)
    return figure


def by_incidence_figure(residuals: Residuals, what: str) -> Any:
    """Median and 90 % bound of the reprojection error over the angle of incidence, which is called `what`, and the
    number of observations."""
    step, start, rows = bins(residuals.incidence)
    figure, ((errors,), (counts,)) = panels(2, 1, 4.0, sharex=True, height_ratios=(3.0, 1.0))
    middle, parts = [start + (k + 0.5) * step for k in rows], [residuals.error[chosen] for chosen in rows.values()]
    errors.plot(middle, [float(error.quantile(NINETY)) for error in parts], "--", color=SECOND, lw=1.5)
    errors.plot(middle, [float(error.median()) for error in parts], "o-", color=ESTIMATE, lw=2.0, ms=5)
    errors.set_ylabel("reprojection error (px)")
    errors.set_ylim(bottom=0.0)
    counts.bar(middle, [len(error) for error in parts], width=0.9 * step, color=PALE)
    counts.set(xlabel=f"{what} (°)", ylabel="observations")
    median = legend_key(marker="o", color=ESTIMATE, label="median")
    legend_above(figure, [median, legend_key(ls="--", color=SECOND, label="90 % are below")])
    return figure


def bins(angle: Float[Tensor, " n"]) -> tuple[float, float, dict[int, Int[Tensor, "_"]]]:
    """Width of the bins in degrees, where the first begins, and the observations in each that has enough of them."""
    low, high = (float(angle.quantile(tail)) for tail in (0.001, 0.999))
    step = next((step for step in STEPS_DEG if high - low <= BINS * step), STEPS_DEG[-1])
    start = step * (low // step)
    number = torch.div(angle - start, step, rounding_mode="floor").long()
    least = min(FEWEST, int(torch.bincount(number.clamp(min=0)).max()))
    rows = {k: (number == k).nonzero()[:, 0] for k in range(int((high - start) // step) + 1)}
    return step, start, {k: chosen for k, chosen in rows.items() if len(chosen) >= least}
