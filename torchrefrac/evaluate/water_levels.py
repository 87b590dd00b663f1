"""How high the water stood in the frame of positions, what decided it, and what contradicts it."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.scene import Finding, Scene, Survey, Surveyed, WarningCode
from torchrefrac.sfm.stated_levels import CONTRADICTED, StatedLevels

IMAGES = "images with positions and ground control"
"""What else than stated levels says where the water is: its refraction."""


def level_metrics(scene: Scene) -> dict[str, Any]:
    """Of a scene in the frame of the positions that its capture or a survey states.

    With UNIT its length unit: water_level_UNIT and water_level_sigma_UNIT, the height of the water there (in the first
    epoch; at the middle of the cameras where it slopes) and its standard deviation; water_levels_UNIT, height and sigma
    by names of epochs, where there are several (in a frame of its own above the first); those of `slope_metrics`.
    water_level_from, of each source of a level the height that it states, its sigma, and weight_percent, how much it
    decided, by inverse variances: levels stated, and the rest.
    """
    known, unit = scene.assessment, scene.length_unit
    if not scene.interfaces.stand_in_world:
        return {}
    found: dict[str, Any] = {}
    if known.lowered_by is not None:
        found[f"water_level_{unit}"] = _at_middle(scene) + known.lowered_by
        if known.water_level_sigma is not None:
            found[f"water_level_sigma_{unit}"] = known.water_level_sigma
    if len(scene.interfaces) > 1:
        found[f"water_levels_{unit}"] = _of_epochs(scene)
    if known.surveyed is not None:
        found |= slope_metrics(scene, known.surveyed.used)
    sources = _sources(scene)
    if sources:
        found["water_level_from"] = sources
    return found


def slope_metrics(scene: Scene, survey: Survey) -> dict[str, float]:
    """Where the levels of the survey that a scene was adjusted with show the slope of its water: by how much that rises
    to the east and to the north, and standard deviations: water_slope_east_mm_per_m, water_slope_east_sigma_mm_per_m,
    and of north the same."""
    known = scene.assessment
    if known.plane_covariance is None or not StatedLevels.of(survey, scene).show_slope(scene):
        return {}
    normal = known.level_from_world @ scene.interfaces.normal[0]
    slope = (-normal[:2] / normal[2]).tolist()
    sigma = known.plane_covariance[0].diagonal()[1:].clamp(min=0.0).sqrt().tolist()
    found = {}
    for name, rise, spread in zip(("east", "north"), slope, sigma, strict=True):
        found[f"water_slope_{name}_mm_per_m"] = 1000.0 * rise
        found[f"water_slope_{name}_sigma_mm_per_m"] = 1000.0 * spread
    return found


def level_contradictions(scene: Scene, known: Surveyed, lowered: float | None) -> tuple[Finding, ...]:
    """Stated levels of the water that everything else contradicts. lowered: see `Assessment.lowered_by`."""
    if not known.stated.level_sources or not scene.interfaces.stand_in_world:
        return ()
    sigma, unit = scene.assessment.level_sigma, scene.length_unit
    if sigma is None and lowered is not None:
        return ()
    if lowered is None or sigma is None:
        message = "a level of the water is stated, but no positions that say where it is counted from; it was not used"
        return (Finding(WarningCode.WATER_LEVEL_CONTRADICTS, message),)
    levels, used = StatedLevels.of(known.stated, scene), _used(known)
    variance = scene.assessment.level_variance(levels.surface, levels.place, levels.place)
    rest = levels.others(levels.at_interfaces(scene), variance.sqrt(), used)
    off, stated = levels.height - rest.height, _heights(known.stated, levels, lowered)
    wrong = off.abs() > CONTRADICTED * torch.hypot(levels.sigma, rest.sigma)
    bed = float(scene.points[:, 2].quantile(0.02)) if len(scene.points) else 0.0
    findings = []
    for i in wrong.nonzero()[:, 0].tolist():
        by, height = float(off[i]), stated[i]
        message = (
            f"{_named(known, i)} states the water at {height:.4g} {unit}, {abs(by):.3g} {unit} "
            f"{'above' if by > 0.0 else 'below'} where everything else has it (+- {float(rest.sigma[i]):.2g} {unit})"
            f"{', below the bed' if float(levels.height[i]) < bed else ''}; it was {'' if used[i] else 'not '}used: "
            "check it, its sigma, and what heights of it and of positions are counted from"
        )
        findings.append(Finding(WarningCode.WATER_LEVEL_CONTRADICTS, message))
    return tuple(findings)


def _of_epochs(scene: Scene) -> dict[str, dict[str, float]]:
    """Height and sigma by name; of a scene in a frame of its own those above the first."""
    known, level = scene.assessment, scene.interfaces.offset
    covariance = torch.zeros_like(level.diag_embed()) if known.level_covariance is None else known.level_covariance
    if known.lowered_by is None:
        above = torch.eye(len(level)).to(level)
        above[:, 0] -= 1.0
        covariance = above @ covariance @ above.mT
    sigma = covariance.diagonal().clamp(min=0.0).sqrt()
    names = scene.capture.epochs if scene.capture is not None else tuple(map(str, range(len(level))))
    heights = (level + (known.lowered_by or 0.0)).tolist()
    return {
        name: {"height": height, "sigma": spread}
        for name, height, spread in zip(names, heights, sigma.tolist(), strict=False)
    }


def _sources(scene: Scene) -> list[dict[str, Any]]:
    """What decided the height of each surface for which levels are stated."""
    known, lowered, sigma = scene.assessment.surveyed, scene.assessment.lowered_by, scene.assessment.level_sigma
    if known is None or lowered is None or sigma is None or not known.stated.level_sources:
        return []
    levels, used = StatedLevels.of(known.stated, scene), _used(known)
    middle = scene.middle[:2].expand_as(levels.place)
    gain = scene.assessment.level_variance(levels.surface, middle, levels.place) / levels.sigma.square()
    above, stated = levels.height - levels.at_interfaces(scene), _heights(known.stated, levels, lowered)
    found = []
    for surface in levels.surface.unique().tolist():
        of, variance = levels.surface == surface, sigma[surface].square()
        share = torch.where(of & used, gain, 0.0)
        total = share.sum()
        share, rest = share / total.clamp(min=1.0), (1.0 - total).clamp(min=0.0)
        off = float((share * above).sum() / rest.clamp(min=torch.finfo(rest.dtype).tiny))
        for i in of.nonzero()[:, 0].tolist():
            found.append(_source(_named(known, i), stated[i], levels.sigma[i], share[i]))
        if float(rest) > 0.0:
            height = float(scene.interfaces.offset[surface]) + _at_middle(scene) + lowered - off
            found.append(_source(IMAGES, height, (variance / rest).sqrt(), rest))
    return found


def _at_middle(scene: Scene) -> float:
    """How much higher than at its origin the plane z = 0 stands at the middle of the cameras."""
    return float((scene.assessment.up[:2] * scene.middle[:2]).sum())


def _heights(stated: Survey, levels: StatedLevels, lowered: float) -> list[float]:
    """Of levels that a survey states, as it states them."""
    places = torch.cat((levels.place, levels.height[:, None]), dim=1)
    return ((places * stated.up).sum(dim=-1) + lowered).tolist()


def _source(name: str, height: float, sigma: Float[Tensor, ""], share: Float[Tensor, ""]) -> dict[str, Any]:
    percent = round(100.0 * float(share), 2)
    return {"source": name, "height": height, "sigma": float(sigma), "weight_percent": percent}


def _named(known: Surveyed, i: int) -> str:
    epoch = known.stated.level_epochs[i]
    return known.stated.level_sources[i] + (f" of {epoch}" if epoch else "")


def _used(known: Surveyed) -> Bool[Tensor, " s"]:
    """Which of the stated sources took part."""
    keys = {*zip(known.used.level_sources, known.used.level_epochs, strict=True)}
    stated = zip(known.stated.level_sources, known.stated.level_epochs, strict=True)
    return torch.tensor([key in keys for key in stated], dtype=torch.bool)
