"""What `torchrefrac correct`, `torchrefrac export` and `torchrefrac triangulate` print."""

from collections.abc import Mapping
from typing import Any

from torchrefrac.record.summary import survey_lines


def correction_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Of a cloud that was corrected, from its metrics."""
    unit = metrics["length_unit"]
    lines = [
        f"{metrics['points_corrected']} of {metrics['points_below_water']} points below the water corrected, of "
        f"{metrics['points']} in all, by {metrics['views_mean']:.1f} cameras each (mean), "
        f"{metrics['seconds_total']:.1f} s",
        f"depth {metrics[f'depth_mean_{unit}']:.4g} {unit} (mean), {metrics[f'depth_max_{unit}']:.4g} {unit} at most, "
        f"{metrics['depth_over_apparent']:.3f} times the apparent one",
        f"the bent rays pass the points at {metrics[f'ray_misfit_rms_{unit}']:.3g} {unit} (RMS), "
        f"{metrics['ray_misfit_percent_of_depth']:.2g} % of the depth",
    ]
    if metrics["points_not_corrected"]:
        west, south, east, north = metrics["not_corrected_extent"]
        lines.append(
            f"not corrected, as too few cameras see them: {metrics['points_not_corrected']} points (views is 0), "
            f"between x {west:.6g} and {east:.6g}, y {south:.6g} and {north:.6g}"
        )
    if metrics["points_without_water"]:
        lines.append(f"{metrics['points_without_water']} points lie where water.surface has no water, and stay")
    return lines + _left(metrics, unit)


def _left(metrics: Mapping[str, Any], unit: str) -> list[str]:
    """What a correction cannot mend."""
    adjust = "`torchrefrac adjust` mends poses and points together"
    if f"error_left_rms_{unit}" not in metrics:
        return [
            "poses of an alignment without water are wrong, too, which no correction of points mends; by how much is "
            f"not known here; {adjust}"
        ]
    left, before = metrics[f"error_left_rms_{unit}"], metrics[f"error_uncorrected_rms_{unit}"]
    line = (
        f"left, if the poses come from an alignment without water: {left:.3g} {unit} (RMS), "
        f"{metrics['error_left_percent_of_depth']:.2g} % of the depth; the cloud as it was: {before:.3g} {unit}; "
        f"{adjust}"
    )
    if left <= before:
        return [line]
    return [line, "the corrected points are farther off than those given: the poses have taken up the refraction"]


def export_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Of cameras that were exported, from the metrics."""
    if metrics["format"] == "survey":
        return [*survey_lines(metrics), f"files: {', '.join(metrics['files'])}"]
    where = f" in {metrics['crs']}" if "crs" in metrics else ""
    return [f"{metrics['images']} cameras{where}: {', '.join(metrics['files'])}"]


def triangulation_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Of tracks that were triangulated, from the metrics."""
    unit = metrics["length_unit"]
    lines = [
        f"{metrics['points']} points from {metrics['observations']} observations in {metrics['images']} views, "
        f"{metrics['seconds_total']:.1f} s",
        f"reprojection error {metrics['reprojection_rms_px']:.3g} px (RMS), standard deviation "
        f"{metrics[f'point_sigma_median_{unit}']:.3g} {unit} (median), with the cameras as certain",
    ]
    if metrics["observations_set_aside"]:
        lines.append(f"{metrics['observations_set_aside']} observations that contradict the others are set aside")
    left_out = {
        "as only one view sees them": metrics["points_of_one_view"],
        "as no two observations agree": metrics["points_contradicted"],
    }
    return lines + [f"left out: {count} points, {why}" for why, count in left_out.items() if count]
