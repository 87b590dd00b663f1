"""Figures about a scene, alone and against truth. Units are in the keys."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.evaluate.point_errors import point_metrics
from torchrefrac.evaluate.true_surface import TrueSurface
from torchrefrac.evaluate.water_levels import level_metrics
from torchrefrac.geometry import Similarity, align_above_plane, align_similarity, rotate, so3_log, split_heading
from torchrefrac.scene import Cameras, Scene, Truth
from torchrefrac.scene.interfaces import PORT, SURFACE, WALL
from torchrefrac.scene.tables import ONLY
from torchrefrac.scene.wording import INTERFACE, kind_of, wording
from torchrefrac.sfm.walls import gravity_in_world

MIN_SIMILARITY_CAMERAS = 3


def summarize(scene: Scene) -> dict[str, Any]:
    """What is known of a finished scene without truth."""
    errors, known = scene.errors(), scene.assessment
    above, outside = (int((mask & scene.placed).sum()) for mask in (scene.above_water(), scene.outside_water()))
    metrics: dict[str, Any] = {
        "images": len(scene.views),
        "registered_images": scene.views.num_registered,
        "points": len(scene.points),
        "points_above_water": above,
        "points_outside_water": outside,
        "observations": len(errors),
        "reprojection_median_px": float(errors.median()) if len(errors) else 0.0,
        "reprojection_rms_px": rms(errors) if len(errors) else 0.0,
        "index_ratio": scene.index_ratio,
        "warnings": [finding.content for finding in scene.findings],
    }
    kind = kind_of(scene)
    if kind != SURFACE:
        metrics[INTERFACE] = kind
    metrics |= intrinsics_metrics(scene) | interface_metrics(scene)
    if known.index_ratio_sigma is not None:
        metrics["index_ratio_sigma"] = known.index_ratio_sigma
    if known.pixel_sigma is not None:
        metrics["pixel_sigma_px"] = known.pixel_sigma
    for name, sigma in (("point", known.point_sigma), ("camera", known.center_sigma)):
        if sigma is not None and len(sigma):
            metrics[f"{name}_sigma_median_{scene.length_unit}"] = float(sigma.median())
    metrics |= against_positions(scene) | level_metrics(scene)
    named = wording(kind).of_quantity
    if known.determined:
        metrics["determined"] = [named(sentence) for sentence in known.determined]
    if known.fixed:
        metrics["held"] = {name: named(sentence) for name, sentence in known.fixed.items()}
    return metrics


def interface_metrics(scene: Scene) -> dict[str, float]:
    """What became of walls and ports; of several of them, the first.

    With UNIT the scene's length unit: wall_upright_off_deg, the angle of the wall from upright by the gravity of its
    photographs, and wall_upright_sigma_deg, with what gravity is known to. Of what was refined of a port:
    port_distance_UNIT and port_tilt_deg, from the optical axis, with standard deviations (port_distance_sigma_UNIT,
    port_tilt_sigma_deg). Of one layer of glass that was refined glass_thickness_UNIT and glass_index, with
    glass_thickness_sigma_UNIT and glass_index_sigma.
    """
    interfaces, known, unit = scene.interfaces, scene.assessment, scene.length_unit
    found: dict[str, float] = {}
    gravity = None if scene.capture is None else gravity_in_world(scene, scene.capture)
    if gravity is not None and interfaces.kinds[0] == WALL:
        along = float(gravity[0] @ interfaces.normal[0])
        found["wall_upright_off_deg"] = math.degrees(math.asin(min(abs(along), 1.0)))
        found["wall_upright_sigma_deg"] = math.degrees(gravity[1])
    if interfaces.kinds[0] == PORT:
        if known.water_level_sigma is not None:
            found[f"port_distance_{unit}"] = -float(interfaces.offset[0])
            found[f"port_distance_sigma_{unit}"] = known.water_level_sigma
        if known.tilt_sigma is not None:
            found["port_tilt_deg"] = math.degrees(math.acos(min(1.0, -float(interfaces.normal[0, 2]))))
            found["port_tilt_sigma_deg"] = math.degrees(known.tilt_sigma)
    for name, sigma in known.layer_sigma.items():
        if name == "layer_thickness":
            found[f"glass_thickness_{unit}"] = float(interfaces.thickness[:, 0].max())
            found[f"glass_thickness_sigma_{unit}"] = sigma
        else:
            found["glass_index"] = float(interfaces.layers[interfaces.thickness[:, 0].argmax(), 0])
            found["glass_index_sigma"] = sigma
    return found


def intrinsics_metrics(scene: Scene) -> dict[str, Any]:
    """What was refined of the cameras, and how well it is known: of camera NAME `camera_NAME_focal_px` (fx; both grow
    by one factor), `camera_NAME_principal_point_px` and `camera_NAME_distortion` (as many coefficients as were
    refined), and standard deviations with `_sigma` before the unit. Without NAME where nobody gave the camera one.
    Nothing of cameras none of whose views is registered."""
    cameras, metrics = scene.cameras, {}
    used = set(scene.views.camera[scene.views.registered].tolist())
    for row, prefix in ((row, prefix) for row, prefix in enumerate(camera_prefixes(cameras)) if row in used):
        for name, sigmas in scene.assessment.intrinsics_sigma.items():
            sigma = sigmas[row]
            if not bool((sigma > 0.0).any()):
                continue
            if name == "focal":
                focal = float(cameras.focal[row, 0])
                metrics |= {f"{prefix}_focal_px": focal, f"{prefix}_focal_sigma_px": focal * float(sigma)}
            elif name == "principal_point":
                metrics[f"{prefix}_principal_point_px"] = cameras.principal_point[row].tolist()
                metrics[f"{prefix}_principal_point_sigma_px"] = sigma.tolist()
            else:
                metrics[f"{prefix}_distortion"] = cameras.distortion[row, : len(sigma)].tolist()
                metrics[f"{prefix}_distortion_sigma"] = sigma.tolist()
    return metrics


def camera_prefixes(cameras: Cameras) -> list[str]:
    """How the metrics of each camera begin."""
    return ["camera"] if cameras.names == (ONLY,) else [f"camera_{name}" for name in cameras.names]


def against_positions(scene: Scene) -> dict[str, float]:
    """Of a scene in the frame of the positions that its capture or a survey states.

    With UNIT its length unit: position_rms_UNIT and position_rms_vertical_UNIT of registered cameras, horizontally and
    in height; heading_off_deg, the median difference of headings, where these are stated.
    """
    capture, lowered, unit = scene.capture, scene.assessment.lowered_by, scene.length_unit
    if capture is None or lowered is None:
        return {}
    views = scene.views
    known = views.registered & capture.position_sigma.isfinite().all(dim=-1)
    level = rotate(scene.assessment.level_from_world, views.center)
    off = (level - capture.position)[known] + level.new_tensor((0.0, 0.0, lowered))
    found = {}
    if len(off):
        found[f"position_rms_{unit}"] = rms(off[:, :2].norm(dim=-1))
        found[f"position_rms_vertical_{unit}"] = rms(off[:, 2])
    compass = views.registered & capture.has_heading
    if bool(compass.any()):
        _, heading = split_heading(views.rotation[compass])
        turned = heading - capture.heading[compass]
        found["heading_off_deg"] = float(torch.atan2(turned.sin(), turned.cos()).abs().median().rad2deg())
    return found


def evaluate(scene: Scene, truth: Truth) -> tuple[dict[str, float | int | str], Similarity | None]:
    """Errors of cameras and points after aligning the cameras to the true ones, and that alignment.

    Refractive: 4-dof alignment, which leaves water plane and vertical alone. Without refraction: the full similarity,
    as in the paper's Table 1. An alignment that the number of common cameras does not determine gives no errors.

    With UNIT the truth's length unit, after the alignment: camera_rms_UNIT, camera_max_UNIT, camera_rotation_rms_deg;
    surface_median_UNIT, surface_rms_UNIT, surface_p95_UNIT: of the points' distance to the nearest place of the true
    surface, where there is one; point_median_UNIT, point_rms_UNIT and flatness_UNIT of `point_metrics`, where the truth
    has an index ratio and intrinsics, too. camera_error_over_sigma, point_error_over_sigma: RMS of the distances, to
    the true centre and to the true surface, over the standard deviation that the scene states for each (a camera's in
    3D, a point's along the axis that is known worst), about 1 where these are honest. true_index_ratio: where the truth
    has it.
    """
    known: dict[str, float | int | str] = {} if truth.index_ratio is None else {"true_index_ratio": truth.index_ratio}
    views = scene.views
    common = [(i, truth.names.index(name)) for i, name in enumerate(views.names) if name in truth.names]
    rows = [(i, j) for i, j in common if bool(views.registered[i])]
    refractive = scene.interfaces.stand_in_world
    if len(rows) < (2 if refractive else MIN_SIMILARITY_CAMERAS):
        return known | {"alignment": "none: too few registered cameras"}, None
    ours, theirs = (torch.tensor(column) for column in zip(*rows, strict=True))
    align = align_above_plane if refractive else align_similarity
    alignment = align(views.center[ours], truth.center[theirs])
    distance = (alignment.apply(views.center[ours]) - truth.center[theirs]).norm(dim=-1)
    turned = alignment.apply_to_rotation(views.rotation[ours])
    angle = so3_log(turned @ truth.rotation[theirs].mT).norm(dim=-1) * 180.0 / torch.pi
    unit = truth.length_unit
    metrics = known | {
        "alignment": "4-dof" if refractive else "similarity",
        f"camera_rms_{unit}": rms(distance),
        f"camera_max_{unit}": float(distance.max()),
        "camera_rotation_rms_deg": rms(angle),
    }
    sigma = scene.assessment.center_sigma
    if sigma is not None:
        of_registered = views.registered.cumsum(dim=0)[ours] - 1
        metrics |= over_sigma("camera", distance, 3.0**0.5 * alignment.scale * sigma[of_registered])
    true_surface = TrueSurface(truth)
    if true_surface.is_known and len(scene.points):
        gap = true_surface.distance(alignment.apply(scene.points))
        metrics |= {
            f"surface_median_{unit}": float(gap.median()),
            f"surface_rms_{unit}": rms(gap),
            f"surface_p95_{unit}": float(gap.quantile(0.95)),
        }
        if scene.assessment.point_sigma is not None:
            metrics |= over_sigma("point", gap, alignment.scale * scene.assessment.point_sigma)
        metrics |= point_metrics(scene, true_surface, alignment)
    return metrics, alignment


def evaluate_run(scene: Scene, truth: Truth | None) -> tuple[dict[str, Any], Similarity | None]:
    """What `summarize` and, where the truth is known, `evaluate` say; and the alignment of the latter."""
    errors, alignment = ({}, None) if truth is None else evaluate(scene, truth)
    return summarize(scene) | errors, alignment


def over_sigma(name: str, error: Float[Tensor, " n"], sigma: Float[Tensor, " n"]) -> dict[str, float]:
    """RMS of errors over their standard deviations, where these are known."""
    known = sigma.isfinite() & (sigma > 0.0)
    return {f"{name}_error_over_sigma": rms(error[known] / sigma[known])} if bool(known.any()) else {}


def rms(values: Float[Tensor, "..."]) -> float:
    """Root mean square of the values."""
    return float(values.square().mean().sqrt())
