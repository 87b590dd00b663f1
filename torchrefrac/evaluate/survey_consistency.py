"""What the images say against a survey: the warnings of an adjustment."""

import math

import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.evaluate.consistency import VAGUE_DEG, about_given, about_images, listed, named
from torchrefrac.evaluate.water_levels import level_contradictions
from torchrefrac.scene import Finding, Scene, Survey, Surveyed, WarningCode
from torchrefrac.sfm.gravity import contradicted_gravity, with_common_tilt
from torchrefrac.sfm.positions import Disagreement, of_centers, surveyed
from torchrefrac.sfm.vertical import angle_between


def survey_contradictions(scene: Scene, survey: Survey, used: Survey) -> tuple[Finding, ...]:
    """All of them, those first that others may follow from. `scene`: what came out, with all its views and its
    assessment, the ground control points of the `survey` being its last points; used: what of the survey it was
    adjusted with."""
    positions = position_contradictions(scene, surveyed(scene, survey, used), 0.0)
    stated = *_gravity(scene, survey), *_tilt(scene), *positions
    return (*about_given(scene), *stated, *about_images(scene))


def position_contradictions(scene: Scene, known: Surveyed | None, lowered: float | None) -> tuple[Finding, ...]:
    """What a scene says against the positions and levels of the survey that it was adjusted with, if it was with one.
    lowered: how much lower than these it stands; None: in a frame of its own."""
    if known is None:
        return ()
    about_places = *_mistake(known), *_positions(scene, known), *_control(scene, known)
    return (*about_places, *level_contradictions(scene, known, lowered))


def _mistake(known: Surveyed) -> list[Finding]:
    """What people do that explains why positions do not fit the images."""
    code = WarningCode.CONTROL_CONTRADICTS if known.stated.control_names else WarningCode.POSITION_CONTRADICTS
    return [Finding(code, f"{known.mistake}; these positions were not used")] if known.mistake else []


def _gravity(scene: Scene, survey: Survey) -> list[Finding]:
    down = torch.zeros_like(scene.views.center).index_copy(0, survey.down_image, survey.down_in_cam)
    sigma = torch.full_like(down[:, 0], torch.inf).index_copy(0, survey.down_image, survey.down_sigma)
    wrong = contradicted_gravity(scene, down, with_common_tilt(scene, sigma))
    names = named(scene.views.names, wrong)
    if not names:
        return []
    off = float(angle_between(scene.down_in_cam[wrong], down[wrong]).rad2deg().median())
    message = (
        f"down_in_cam of {listed(names)} is {off:.2g} degrees (median) from the vertical that the images show, more "
        "than its sigma explains: check it, its sigma, and that z points up"
    )
    return [Finding(WarningCode.GRAVITY_CONTRADICTS, message, names)]


def _tilt(scene: Scene) -> list[Finding]:
    """Whether a normal of the water that was looked for is known well enough."""
    sigma = math.degrees(scene.assessment.tilt_sigma or 0.0)
    if sigma <= VAGUE_DEG:
        return []
    message = (
        f"the images show how the water lies to the cameras to {sigma:.1f} degrees only: heights and depths may be off "
        "by some percent, slopes by as much; give down_in_cam or positions in a survey, or the normal of the plane"
    )
    return [Finding(WarningCode.GRAVITY_UNDETERMINED, message)]


def _positions(scene: Scene, known: Surveyed) -> list[Finding]:
    off, image = of_centers(scene, known.stated), known.stated.center_image
    names = tuple(scene.views.names[i] for i in image.tolist())
    left_out = ~torch.isin(image, known.used.center_image)
    message = _message(off, names, left_out, "center", "images", scene.length_unit)
    return [Finding(WarningCode.POSITION_CONTRADICTS, message, named(names, off.contradicted))] if message else []


def _control(scene: Scene, known: Surveyed) -> list[Finding]:
    off, control = Disagreement(known.distance, known.deviations), known.stated.known_control
    names = tuple(known.stated.control_names[i] for i in control.tolist())
    left_out = off.deviations.isinf() | ~torch.isin(control, known.used.known_control)
    message = _message(off, names, left_out, "position or observations", "marks", scene.length_unit)
    return [Finding(WarningCode.CONTROL_CONTRADICTS, message)] if message else []


def _message(
    off: Disagreement, names: tuple[str, ...], left_out: Bool[Tensor, " k"], what: str, of: str, unit: str
) -> str:
    """Which of the names are how far off; nothing where none is."""
    wrong = named(names, off.contradicted)
    if not wrong:
        return ""
    far = off.distance[off.contradicted].tolist()
    shown = ", ".join(f"{name}: {distance:.3g} {unit}" for name, distance in [*zip(wrong, far, strict=True)][:3])
    used = "it was used, as no majority agrees" if not bool(left_out.any()) else "what most contradict was not used"
    return (
        f"{what} of {listed(wrong, of)} is farther from where the images have it than its sigma explains ({shown}); "
        f"{used}: check it and its sigma"
    )
