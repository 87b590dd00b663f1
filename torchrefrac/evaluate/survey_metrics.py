"""What metrics.json says of a survey that a scene was adjusted with."""

from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.evaluate.metrics import rms
from torchrefrac.geometry import levelling, rotate
from torchrefrac.scene import Surveyed


def survey_metrics(known: Surveyed | None, unit: str, level: float = 0.0) -> dict[str, Any]:
    """Where the ground control points are, in the frame of the survey, which is `level` lower than that of the scene;
    how far the places where the rays of their pixels meet are from those that are stated; and what was left out.

    With UNIT the length unit: marks, positions by name; mark_residuals_UNIT, differences [x, y, z] by name, and
    mark_rms_UNIT, of their lengths, of those that took part; control_points and check_points, rows with name, dx, dy,
    dz, distance, and sigma, the standard deviations [x, y, z] of where the point is; control_rms_xy_UNIT,
    control_rms_z_UNIT, check_rms_xy_UNIT, check_rms_z_UNIT; lost_marks: those that do not fit, or are not seen;
    images_only_in_survey.
    """
    if known is None:
        return {}
    stated, up = known.stated, known.control.new_tensor((0.0, 0.0, level))
    turn = levelling(-stated.up)
    where, placed = (rotate(turn, known.control) + up).tolist(), known.placed.tolist()
    of_known, of_check = rotate(turn, known.off), rotate(turn, known.check_off)
    control = list(zip(stated.control_names, where, placed, strict=True))
    compared = {
        stated.control_names[i]: off for i, off in zip(stated.known_control.tolist(), of_known.tolist(), strict=True)
    }
    found: dict[str, Any] = {
        "marks": {name: position for name, position, there in control if there},
        f"mark_residuals_{unit}": compared,
        **_table(known, "control", stated.known_control, of_known, unit),
        **_table(known, "check", stated.check_control, of_check, unit),
        "lost_marks": [*(name for name, _, there in control if not there), *stated.skipped_controls],
        "images_only_in_survey": list(stated.skipped),
    }
    if compared:
        found[f"mark_rms_{unit}"] = rms(known.off.norm(dim=-1))
    return {name: value for name, value in found.items() if value}


def _table(
    known: Surveyed, kind: str, control: Int[Tensor, " k"], off: Float[Tensor, "k 3"], unit: str
) -> dict[str, Any]:
    """A row for each point whose rays meet, and the root mean squares of these."""
    met = known.met[control]
    control, off = control[met], off[met]
    if not len(off):
        return {}
    columns = zip(control.tolist(), off.tolist(), off.norm(dim=-1).tolist(), strict=True)
    rows = []
    for i, (x, y, z), distance in columns:
        row: dict[str, Any] = {"name": known.stated.control_names[i], "dx": x, "dy": y, "dz": z, "distance": distance}
        if bool(known.sigma[i].isfinite().all()):
            row["sigma"] = known.sigma[i].tolist()
        rows.append(row)
    horizontal, vertical = rms(off[:, :2].norm(dim=-1)), rms(off[:, 2])
    return {f"{kind}_points": rows, f"{kind}_rms_xy_{unit}": horizontal, f"{kind}_rms_z_{unit}": vertical}
