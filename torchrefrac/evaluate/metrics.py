"""Figures about a reconstruction, alone and against truth. Units are in the keys."""

from typing import Any

import torch
from torch import Tensor

from torchrefrac.evaluate.point_errors import point_metrics
from torchrefrac.evaluate.true_surface import TrueSurface
from torchrefrac.geometry import Similarity, align_above_plane, align_similarity, so3_log
from torchrefrac.scene import Reconstruction, Truth

MIN_SIMILARITY_CAMERAS = 3


def summarize(reconstruction: Reconstruction) -> dict[str, Any]:
    """What can be said without truth."""
    errors = reconstruction.reprojection_errors()
    count, known, unit = len(errors), reconstruction.assessment, reconstruction.length_unit
    metrics: dict[str, Any] = {
        "images": len(reconstruction.names),
        "registered_images": int(reconstruction.registered.sum()),
        "points": len(reconstruction.points),
        "observations": count,
        "reprojection_median_px": float(errors.median()) if count else 0.0,
        "reprojection_rms_px": float(errors.square().mean().sqrt()) if count else 0.0,
        "index_ratio": reconstruction.index_ratio,
    }
    if known.index_ratio_sigma is not None:
        metrics["index_ratio_sigma"] = known.index_ratio_sigma
    if known.pixel_sigma is not None:
        metrics["pixel_sigma_px"] = known.pixel_sigma
    for name, sigma in (("point", known.point_sigma), ("camera", known.center_sigma)):
        if sigma is not None and len(sigma):
            metrics[f"{name}_sigma_median_{unit}"] = float(sigma.median())
    if known.determined:
        metrics["determined"] = list(known.determined)
    if known.held:
        metrics["held"] = dict(known.held)
    return metrics


def evaluate(reconstruction: Reconstruction, truth: Truth) -> tuple[dict[str, float | int | str], Similarity | None]:
    """Errors of cameras and points after aligning the cameras to the true ones, and that alignment.

    Refractive: 4-dof alignment, which leaves water plane and vertical alone. Without refraction: the full similarity,
    as in the paper's Table 1. An alignment that the number of common cameras does not determine gives no errors.

    With UNIT the truth's length unit, after the alignment: camera_rms_UNIT, camera_max_UNIT, camera_rotation_rms_deg;
    surface_median_UNIT, surface_rms_UNIT, surface_p95_UNIT: of the points' distance to the nearest place of the true
    surface, where there is one; point_median_UNIT, point_rms_UNIT and flatness_UNIT of `point_metrics`, where the truth
    has an index ratio and a lens, too. true_index_ratio: where the truth has it.
    """
    known: dict[str, float | int | str] = {}
    if truth.index_ratio is not None:
        known["true_index_ratio"] = truth.index_ratio
    common = [(i, truth.names.index(name)) for i, name in enumerate(reconstruction.names) if name in truth.names]
    rows = [(i, j) for i, j in common if bool(reconstruction.registered[i])]
    refractive = reconstruction.index_ratio > 1.0
    if len(rows) < (2 if refractive else MIN_SIMILARITY_CAMERAS):
        return known | {"alignment": "none: too few registered cameras"}, None
    ours, theirs = (torch.tensor(column) for column in zip(*rows, strict=True))
    align = align_above_plane if refractive else align_similarity
    alignment = align(reconstruction.center[ours], truth.center[theirs])
    distance = (alignment.apply(reconstruction.center[ours]) - truth.center[theirs]).norm(dim=-1)
    turned = alignment.apply_to_rotation(reconstruction.rotation[ours])
    angle = so3_log(turned @ truth.rotation[theirs].mT).norm(dim=-1) * 180.0 / torch.pi
    unit = truth.length_unit
    metrics = known | {
        "alignment": "4-dof" if refractive else "similarity",
        f"camera_rms_{unit}": rms(distance),
        f"camera_max_{unit}": float(distance.max()),
        "camera_rotation_rms_deg": rms(angle),
    }
    true_surface = TrueSurface(truth)
    if true_surface.is_known and len(reconstruction.points):
        gap = true_surface.distance(alignment.apply(reconstruction.points))
        metrics |= {
            f"surface_median_{unit}": float(gap.median()),
            f"surface_rms_{unit}": rms(gap),
            f"surface_p95_{unit}": float(gap.quantile(0.95)),
        }
        metrics |= point_metrics(reconstruction, true_surface, alignment)
    return metrics, alignment


def rms(values: Tensor) -> float:
    """Root mean square of the values."""
    return float(values.square().mean().sqrt())
