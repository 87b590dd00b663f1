"""How high the water stood in the frame of positions, what decided it, and what contradicts it."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.scene import Finding, Scene, Surveyed, WarningCode
from torchrefrac.sfm.stated_levels import CONTRADICTED, StatedLevels

IMAGES = "images with positions and ground control"
"""What else than stated levels says where the water is: its refraction."""


def level_metrics(scene: Scene) -> dict[str, Any]:
    """Of a scene in the frame of the positions that its capture or a survey states.

    With UNIT its length unit: water_level_UNIT and water_level_sigma_UNIT, the height of the water there (in the first
    epoch) and its standard deviation; water_levels_UNIT, height and sigma by names of epochs, where there are several
    (in a frame of its own above the first). water_level_from, of each source of a level the height that it states, its
    sigma, and weight_percent, how much it decided, by inverse variances: levels stated, and the rest.
    """
    known, unit = scene.assessment, scene.length_unit
    if not scene.interfaces.stand_in_world:
        return {}
    found: dict[str, Any] = {}
    if known.lowered_by is not None:
        found[f"water_level_{unit}"] = known.lowered_by
        if known.water_level_sigma is not None:
            found[f"water_level_sigma_{unit}"] = known.water_level_sigma
    if len(scene.interfaces) > 1:
        found[f"water_levels_{unit}"] = _of_epochs(scene)
    sources = _sources(scene)
    if sources:
        found["water_level_from"] = sources
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
    rest = levels.others(scene.interfaces.offset, sigma, used)
    off = levels.height - rest.height
    wrong = off.abs() > CONTRADICTED * torch.hypot(levels.sigma, rest.sigma)
    bed = float(scene.points[:, 2].quantile(0.02)) if len(scene.points) else 0.0
    findings = []
    for i in wrong.nonzero()[:, 0].tolist():
        by, height = float(off[i]), float(levels.height[i]) + lowered
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
    found = []
    for surface in levels.surface.unique().tolist():
        of, variance = levels.surface == surface, sigma[surface].square()
        share = torch.where(of & used, variance / levels.sigma.square(), 0.0)
        stated = share.sum()
        share, rest = share / stated.clamp(min=1.0), (1.0 - stated).clamp(min=0.0)
        height = scene.interfaces.offset[surface] - (share * levels.height).sum()
        for i in of.nonzero()[:, 0].tolist():
            found.append(_source(_named(known, i), float(levels.height[i]) + lowered, levels.sigma[i], share[i]))
        if float(rest) > 0.0:
            found.append(_source(IMAGES, float(height / rest) + lowered, (variance / rest).sqrt(), rest))
    return found


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
