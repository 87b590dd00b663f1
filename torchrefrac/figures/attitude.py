"""The paper's Figure 6: the attitude of the cameras as reconstructed, as measured, and as it was."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.figures import plotting
from torchrefrac.figures.plotting import ESTIMATE, MEASURED, TRUE, legend_above, legend_key, number_images, rounded
from torchrefrac.figures.side_views import INK, true_of
from torchrefrac.geometry import split_heading
from torchrefrac.scene import Capture, Scene, Truth
from torchrefrac.sfm.frame import levelling
from torchrefrac.sfm.walls import gravity_in_world


@dataclass(frozen=True)
class Angle:
    """One angle of k images in degrees: estimated, and where they are known measured and true (NaN: not of that image).

    The differences wrap at half a turn.
    """

    name: str
    estimated: Float[Tensor, " k"]
    measured: Float[Tensor, " k"] | None
    true: Float[Tensor, " k"] | None

    def error(self, reference: Float[Tensor, " k"] | None) -> Float[Tensor, " k"] | None:
        """Estimated minus `reference`."""
        return None if reference is None else wrapped(self.estimated - reference)


def attitudes(scene: Scene, capture: Capture | None, truth: Truth | None) -> tuple[Int[Tensor, " k"], list[Angle]]:
    """Numbers of the registered images, and their roll, pitch and heading.

    Roll and pitch say by how much the right and the lower side of the image dip below the horizontal, so both are 0 of
    a camera that looks straight down. Before a wall, where gravity is known, pitch is how much the optical axis dips.
    The reconstruction's heading is free: what is measured and true is turned by the mean difference. Heading is left
    out where nothing says what it was.
    """
    images = scene.views.registered.nonzero()[:, 0]
    beside = capture is not None and capture.names == scene.views.names
    gravity = gravity_in_world(scene, capture) if capture is not None and beside else None
    z_up = torch.eye(3, dtype=torch.float64) if gravity is None else levelling(gravity[0]).mT
    pitch = 1 if gravity is None else 2
    down, heading = split_heading(scene.views.rotation[images] @ z_up)
    heading = heading[:1] + torch.cat((heading.new_zeros(1), wrapped(heading.diff().rad2deg()).deg2rad())).cumsum(dim=0)
    sensed_down = sensed_heading = true_down = true_heading = None
    if capture is not None and beside:
        unknown, headed = capture.down_sigma[images].isinf()[:, None], capture.has_heading[images]
        sensed_down = capture.down_in_cam[images].where(~unknown, torch.nan) if capture.has_gravity else None
        sensed_heading = capture.heading[images].rad2deg().where(headed, torch.nan) if bool(headed.any()) else None
    if truth is not None:
        names = [scene.views.names[i] for i in images.tolist()]
        true_down, turn = split_heading(true_of(truth.rotation, truth, names) @ z_up)
        true_heading = turn.rad2deg()
    angles = [
        Angle(name, _dip(down, axis), *(None if d is None else _dip(d, axis) for d in (sensed_down, true_down)))
        for name, axis in (("roll", 0), ("pitch", pitch))
    ]
    if sensed_heading is not None or true_heading is not None:
        degrees = heading.rad2deg()
        angles.append(Angle("heading", degrees, _turned_to(degrees, sensed_heading), _turned_to(degrees, true_heading)))
    return images, angles


def attitude_figure(images: Int[Tensor, " k"], angles: Sequence[Angle], count: int) -> Any:
    """A row an angle: on the left what it is, on the right by how much estimated and known differ."""
    figure, grid = plotting.panels(len(angles), 2, 0.7 + 1.75 * len(angles), sharex="col", width_ratios=(1.0, 1.0))
    numbers = (images + 1).numpy()
    for (values, errors), angle in zip(grid, angles, strict=True):
        if angle.true is not None:
            values.plot(numbers, angle.true.numpy(), "-", color=TRUE, lw=1.5, zorder=2)
        if angle.measured is not None:
            values.plot(numbers, angle.measured.numpy(), "s", mfc="none", color=MEASURED, ms=7, zorder=3)
        values.plot(numbers, angle.estimated.numpy(), "o", color=ESTIMATE, ms=4, zorder=4)
        values.set_ylabel(f"{angle.name} (°)")
        errors.axhline(0.0, color="#9aa1a8", lw=1.0)
        for reference, color, marker in ((angle.measured, MEASURED, "s"), (angle.true, TRUE, "D")):
            error = angle.error(reference)
            if error is not None:
                errors.plot(numbers, error.numpy(), marker, color=color, ms=5, mfc="none" if marker == "s" else color)
    grid[0][0].set_title("angle", fontsize=11)
    grid[0][1].set_title("estimated minus known", fontsize=11)
    for panel in grid[-1]:
        number_images(panel, count)
    handles = [legend_key(marker="o", ls="", color=ESTIMATE, label="estimated")]
    if any(angle.measured is not None for angle in angles):
        handles.append(legend_key(marker="s", ls="", mfc="none", color=MEASURED, label="measured (IMU)"))
    if any(angle.true is not None for angle in angles):
        handles.append(legend_key(marker="D", ms=4, color=TRUE, label="true"))
    legend_above(figure, handles)
    return figure


def models_attitude_figure(
    found: Mapping[str, tuple[Int[Tensor, " k"], Sequence[Angle]]], styles: Mapping[str, Mapping[str, Any]], count: int
) -> Any:
    """The paper's Figure 6: the angles that several models find, by their titles, and what the IMU measured.

    A row an angle: on the left what it is, on the right what the models find minus what was measured. styles: color and
    marker of each title. Headings of all are drawn on the branch of the first; measured ones are those that belong to
    the last.
    """
    images, measured = list(found.values())[-1]
    first = next(iter(found.values()))[1]
    figure, grid = plotting.panels(len(first), 2, 0.7 + 1.75 * len(first), sharex="col", width_ratios=(1.0, 1.0))
    for row, (values, errors) in enumerate(grid):
        errors.axhline(0.0, color="#9aa1a8", lw=1.0)
        values.set_ylabel(f"{first[row].name} (°)")
        for title, (numbers, angles) in found.items():
            angle, style = angles[row], {"ms": 4, "lw": 1.0, **styles[title]}
            whole = 360.0 * ((angle.estimated[:1] - first[row].estimated[:1]) / 360.0).round()
            values.plot((numbers + 1).numpy(), (angle.estimated - whole).numpy(), "-", **style, zorder=3)
            error = angle.error(angle.measured)
            if error is not None:
                errors.plot((numbers + 1).numpy(), error.numpy(), "-", **style, zorder=3)
        known = measured[row].measured
        if known is not None:
            whole = 360.0 * ((known[:1] - first[row].estimated[:1]) / 360.0).round()
            shown = (known - whole).numpy()
            values.plot((images + 1).numpy(), shown, "s", mfc="none", color=INK, ms=8, zorder=2)
    grid[0][0].set_title("angle", fontsize=11)
    grid[0][1].set_title("estimated minus IMU", fontsize=11)
    for panel in grid[-1]:
        number_images(panel, count)
    handles = [legend_key(label=title, ms=4, lw=1.0, **styles[title]) for title in found]
    if any(angle.measured is not None for angle in measured):
        handles.append(legend_key(marker="s", ls="", mfc="none", color=INK, label="measured (IMU)"))
    legend_above(figure, handles)
    return figure


def attitude_words(angles: Sequence[Angle]) -> str:
    """RMS of the differences, in one sentence."""
    parts = []
    for name, pick in (("the IMU", "measured"), ("the truth", "true")):
        errors = [(a.name, a.error(getattr(a, pick))) for a in angles]
        known = [f"{n} {rounded(rms(e))}°" for n, e in errors if e is not None and bool(e.isfinite().any())]
        if known:
            parts.append(f"against {name} {', '.join(known)}")
    return f"RMS differences {'; '.join(parts)}." if parts else ""


def wrapped(degrees: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The same angles between -180 and 180 degrees."""
    return torch.remainder(degrees + 180.0, 360.0) - 180.0


def rms(values: Float[Tensor, " n"]) -> float:
    """Root mean square of those that are known (not NaN)."""
    return math.sqrt(float(values[values.isfinite()].square().mean()))


def _dip(down: Float[Tensor, "k 3"], axis: int) -> Float[Tensor, " k"]:
    return down[:, axis].clamp(-1.0, 1.0).asin().rad2deg()


def _turned_to(estimated: Float[Tensor, " k"], reference: Float[Tensor, " k"] | None) -> Float[Tensor, " k"] | None:
    """The reference turned by the mean difference, on the branch next to the estimated heading."""
    if reference is None:
        return None
    difference = (estimated - reference).deg2rad()
    known = difference.isfinite()
    mean = torch.atan2(difference[known].sin().mean(), difference[known].cos().mean()).rad2deg()
    return estimated - wrapped(estimated - reference - mean)
