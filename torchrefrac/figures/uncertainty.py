"""How well each camera centre is determined, drawn large enough to be seen."""

import math
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.figures.plotting import ESTIMATE, SECOND, legend_above, legend_key, number_images, panels
from torchrefrac.figures.side_views import true_of
from torchrefrac.scene import Scene, Truth
from torchrefrac.scene.wording import Wording

SHARE = 0.1  # of the extent of the cameras that a typical ellipse takes
STEPS = (1.0, 2.0, 5.0, 10.0)


def ellipse_axes(
    covariance: Float[Tensor, "k 2 2"],
) -> tuple[Float[Tensor, " k"], Float[Tensor, " k"], Float[Tensor, " k"]]:
    """Long and short half axes of the ellipses of one standard deviation, and the angle of the long ones in degrees."""
    values, vectors = torch.linalg.eigh(covariance)
    axes = values.clamp(min=0.0).sqrt()
    return axes[:, 1], axes[:, 0], torch.atan2(vectors[:, 1, 1], vectors[:, 0, 1]).rad2deg()


def exaggeration(size: float, extent: float) -> float:
    """1, 2 or 5 times a power of ten, at least 1, that makes `size` about a tenth of the extent."""
    wanted = SHARE * extent / size if size > 0.0 else 1.0
    if not 1.0 < wanted < math.inf:
        return 1.0
    power = 10.0 ** math.floor(math.log10(wanted))
    return max(step * power for step in STEPS if step * power <= wanted * (1.0 + 1e-9))


def uncertainty_figure(shown: Scene, truth: Truth | None, words: Wording) -> tuple[Any, float]:
    """Ellipses of one standard deviation along z, and the standard deviation of z; and the factor by which the ellipses
    are exaggerated. Arrows are the true errors, by the same factor, where `truth` is given."""
    from matplotlib.patches import Ellipse, Patch  # noqa: PLC0415 - slow to import

    covariance = shown.assessment.center_covariance
    if covariance is None:
        raise ValueError("the reconstruction has no covariance of its camera centres")
    images, unit = shown.views.registered.nonzero()[:, 0], shown.length_unit
    centers = shown.views.center[images]
    extent = (centers[:, :2].amax(dim=0) - centers[:, :2].amin(dim=0)).clamp(min=1e-9)
    long, short, direction = ellipse_axes(covariance[:, :2, :2])
    factor = exaggeration(float(long.median()), float(extent.max()))
    figure, ((above, heights),) = panels(1, 2, 4.2, width_ratios=(1.0, 1.05))
    x, y, _ = centers.numpy().T
    above.plot(x, y, "-", color="#c9ced3", lw=1.0, zorder=1)
    for at, a, b, angle in zip(centers[:, :2].tolist(), *(v.tolist() for v in (long, short, direction)), strict=True):
        size = (2.0 * factor * a, 2.0 * factor * b)
        above.add_patch(Ellipse(at, *size, angle=angle, fc="#56b4e955", ec=ESTIMATE, lw=1.3, zorder=2))
    above.plot(x, y, ".", color=ESTIMATE, ms=4, zorder=3)
    handles: list[Any] = [Patch(fc="#56b4e955", ec=ESTIMATE, label="one standard deviation")]
    sigma = covariance[:, 2, 2].clamp(min=0.0).sqrt()
    numbers = (images + 1).numpy()
    heights.bar(numbers, sigma.numpy(), width=0.65, color="#56b4e9")
    if truth is not None:
        errors = true_errors(shown, truth, images).numpy()
        above.quiver(
            x, y, factor * errors[:, 0], factor * errors[:, 1],
            angles="xy", scale_units="xy", scale=1.0, color=SECOND, width=0.005, zorder=4,
        )  # fmt: skip
        heights.plot(numbers, abs(errors[:, 2]), "D", color=SECOND, ms=5)
        handles.append(legend_key(marker="D", ls="", ms=5, color=SECOND, label="true error (arrows and diamonds)"))
    above.set_title(f"{words.along_z}, errors {factor:g} times as large", fontsize=11)
    above.set(xlabel=f"x ({unit})", ylabel=f"{words.y} ({unit})")
    above.set_aspect("equal", adjustable="datalim")
    above.margins(0.12)
    heights.set_title(words.z, fontsize=11)
    heights.set_ylabel(f"standard deviation ({unit})")
    heights.grid(visible=False, axis="x")
    number_images(heights, len(shown.views.names))
    legend_above(figure, handles)
    return figure, factor


def true_errors(shown: Scene, truth: Truth, images: Int[Tensor, " k"]) -> Float[Tensor, "k 3"]:
    """From the true centre of each of `images` to the reconstructed one; NaN where the truth lacks it."""
    return shown.views.center[images] - true_of(truth.center, truth, [shown.views.names[i] for i in images.tolist()])
