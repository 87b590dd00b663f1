"""What a command prints when it is done."""

from collections.abc import Mapping, Sequence
from typing import Any

from torchrefrac.evaluate.dense_metrics import FOUND, TYPICAL, without_outliers
from torchrefrac.evaluate.survey_orders import ORDERS
from torchrefrac.record.terminal import wrapped
from torchrefrac.scene.interfaces import SURFACE
from torchrefrac.scene.wording import INTERFACE, wording

COMPARED = (("control", "ground control points"), ("check", "check points"))
"""Points of a survey by what names of metrics begin with, and what they are called."""
LEFT_OUT = {
    "lost_images": "images left out, as too few of their points fit",
    "lost_marks": "ground control points left out, as they do not fit or are not seen",
    "images_only_in_survey": "images of the survey that the alignment does not have",
}


def summary(lines: Sequence[str]) -> str:
    """One text, wrapped for the terminal."""
    return "\n".join(map(wrapped, lines))


def adjustment_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Of `torchrefrac adjust`, from its metrics."""
    unit, sigma = metrics["length_unit"], metrics["index_ratio_sigma"]
    spread = "" if sigma is None else f" +- {sigma:.2g}"
    lines = [
        f"{metrics['adjusted_images']} of {metrics['images']} images adjusted, {metrics['points']} points "
        f"({metrics['dropped_points']} dropped), {metrics['observations']} observations "
        f"({metrics['dropped_observations']} dropped)",
        f"median reprojection error {metrics['reprojection_median_px']:.3f} px, through {_through(metrics)} before "
        f"{metrics['reprojection_median_before_px']:.3f} px, {metrics['seconds_total']:.1f} s",
        f"index ratio {metrics['index_ratio']:.4f}{spread}, cameras moved by "
        f"{metrics[f'camera_shift_median_{unit}']:.4g} {unit} (median), "
        f"{metrics[f'camera_shift_max_{unit}']:.4g} {unit} at most",
        *metrics["determined"],
    ]
    lines += [f"not refined: {sentence}" for sentence in metrics["held"].values()]
    return lines + _of_survey(metrics) + _against_truth(metrics) + warning_lines(metrics)


def _through(metrics: Mapping[str, Any]) -> str:
    """What was looked through."""
    return wording(metrics.get(INTERFACE, SURFACE)).glass


def _of_survey(metrics: Mapping[str, Any]) -> list[str]:
    """How ground control fits, and what was left out of what was measured on site."""
    left_out = [f"{words}: {', '.join(metrics[key])}" for key, words in LEFT_OUT.items() if key in metrics]
    return [*(line for kind in COMPARED for line in _compared(metrics, *kind)), *_levels(metrics), *left_out]


def _compared(metrics: Mapping[str, Any], kind: str, words: str) -> list[str]:
    """How far points of a kind are from where they are stated."""
    unit = _unit_of(metrics, f"{kind}_rms_xy_")
    if unit is None:
        return []
    count = len(metrics[f"{kind}_points"])
    return [
        f"{count} {words} {'meets' if count == 1 else 'meet'} {metrics[f'{kind}_rms_xy_{unit}']:.3g} {unit} (xy) and "
        f"{metrics[f'{kind}_rms_z_{unit}']:.3g} {unit} (z) RMS from where they are stated"
    ]


def _levels(metrics: Mapping[str, Any]) -> list[str]:
    """Where the water stood, by epochs, and what decided it where levels were stated."""
    unit = _unit_of(metrics, "water_levels_")
    epochs = {} if unit is None else metrics[f"water_levels_{unit}"]
    lines = [f"water of {name}: {level['height']:.6g} {unit} +- {level['sigma']:.2g}" for name, level in epochs.items()]
    sources = [f"{each['source']} {each['weight_percent']:.3g} %" for each in metrics.get("water_level_from", [])]
    if "water_slope_east_mm_per_m" in metrics:
        rises = [
            f"{metrics[f'water_slope_{name}_mm_per_m']:.3g} +- "
            f"{metrics[f'water_slope_{name}_sigma_mm_per_m']:.2g} mm/m to the {name}"
            for name in ("east", "north")
        ]
        lines.append(f"the water rises by {', '.join(rises)}")
    return [*lines, f"level of the water from {', '.join(sources)}"] if sources else lines


def _against_truth(metrics: Mapping[str, Any]) -> list[str]:
    unit = _unit_of(metrics, "camera_rms_")
    if unit is None:
        return []
    line = f"against truth ({metrics['alignment']} alignment): cameras {metrics[f'camera_rms_{unit}']:.4f} {unit} RMS"
    if f"surface_median_{unit}" in metrics:
        line += f", points {metrics[f'surface_median_{unit}']:.4f} {unit} from the surface (median)"
    if f"flatness_{unit}" in metrics:
        line += f", bent by {metrics[f'flatness_{unit}']:.4f} {unit}"
    return [line]


def reconstruction_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Of a reconstruction, from its metrics."""
    lines = [
        f"{metrics['registered_images']} of {metrics['images']} images registered, {metrics['points']} points, "
        f"median reprojection error {metrics['reprojection_median_px']:.3f} px, {metrics['seconds_total']:.1f} s"
    ]
    if metrics.get("points_outside_water"):
        place = wording(metrics.get(INTERFACE, SURFACE))
        wet = metrics["points"] - metrics["points_above_water"] - metrics["points_outside_water"]
        lines.append(
            f"{wet} points under water, {metrics['points_above_water']} {place.above} {place.level}, "
            f"{metrics['points_outside_water']} {place.below} it, but outside the water"
        )
    lines += [f"not registered: {name} {reason}" for name, reason in metrics.get("not_registered", {}).items()]
    lines += [
        f"{count} images are a reconstruction of their own, in {name}/, which nothing joins with the others"
        for name, count in metrics.get("reconstructions", {}).items()
    ]
    if metrics["gravity"] == "estimated":
        lines.append(
            "gravity was estimated from the refraction; the verticals are determined to "
            f"{metrics['gravity_sigma_deg']:.1f} degrees"
        )
    if "wall_normal_sigma_deg" in metrics:
        lines.append(
            "the normal of the wall was found by the refraction, in each image to "
            f"{metrics['wall_normal_sigma_deg']:.1f} degrees at first"
        )
    if "wall_upright_off_deg" in metrics:
        lines.append(
            f"by gravity the wall is {metrics['wall_upright_off_deg']:.2g} degrees from upright "
            f"(+- {metrics['wall_upright_sigma_deg']:.2g})"
        )
    lines += _of_port(metrics)
    if "index_ratio_sigma" in metrics:
        lines.append(f"index ratio {metrics['index_ratio']:.4f} +- {metrics['index_ratio_sigma']:.2g}")
    lines += [f"not refined: {sentence}" for sentence in metrics.get("held", {}).values()]
    lines += _of_survey(metrics)
    lines += _against_truth(metrics) + (dense_lines(metrics) if "dense_points" in metrics else [])
    return lines + survey_lines(metrics) + warning_lines(metrics)


def _of_port(metrics: Mapping[str, Any]) -> list[str]:
    """What was found of a port, where it was refined."""
    found = []
    unit = _unit_of(metrics, "port_distance_sigma_")
    if unit is not None:
        sigma = metrics[f"port_distance_sigma_{unit}"]
        found.append(f"{metrics[f'port_distance_{unit}']:.4g} {unit} ahead (+- {sigma:.2g})")
    if "port_tilt_deg" in metrics:
        found.append(f"tilted by {metrics['port_tilt_deg']:.3g} degrees (+- {metrics['port_tilt_sigma_deg']:.2g})")
    return [f"port found {', '.join(found)}"] if found else []


def survey_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Of the bed on the map, from the metrics of a run; none where it was not put there."""
    lines = []
    unit = _unit_of(metrics, "land_difference_median_")
    if unit is not None:
        lines.append(
            f"land: {metrics['land_points_compared']} points, {metrics[f'land_difference_median_{unit}']:.2g} {unit} "
            f"(median) from where they are without refraction, {metrics[f'land_rise_median_{unit}']:+.2g} {unit} in "
            "height"
        )
    unit = _unit_of(metrics, "bed_sigma_median_")
    if unit is None:
        return lines
    line = (
        f"bed: {metrics[f'bed_area_{unit}2']:.4g} {unit}^2, depth {metrics[f'depth_median_{unit}']:.3g} {unit} "
        f"(median), standard deviation of heights {metrics[f'bed_sigma_median_{unit}']:.2g} {unit} (median)"
    )
    known = [(order.name, metrics.get(f"s44_{order.name}_percent")) for order in ORDERS]
    orders = [f"{name} {share:g} %" for name, share in known if share is not None]
    return [*lines, line + (f"; S-44: {', '.join(orders)}" if orders else "")]


def _unit_of(metrics: Mapping[str, Any], stem: str) -> str | None:
    """The unit in which the first metric whose name begins so stands; None where there is none."""
    return next((key.removeprefix(stem) for key in metrics if key.startswith(stem)), None)


def warning_lines(metrics: Mapping[str, Any]) -> list[str]:
    """What the images say against what was stated."""
    return [f"warning ({warning['code']}): {warning['message']}" for warning in metrics.get("warnings", [])]


def dense_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Of a dense stage, from the metrics of its run."""
    speed = f" ({metrics['dense_patches_per_s']:.0f} patches/s)" if "dense_patches_per_s" in metrics else ""
    again = metrics.get("dense_images_resumed")
    resumed = f", with {again} {'image' if again == 1 else 'images'} from before" if again else ""
    lines = [
        f"dense ({metrics['dense_method']}): {metrics['dense_points']} points in {metrics['seconds_dense']:.1f} s"
        f"{speed}{resumed}, each in {metrics['dense_views_median']:.0f} images (median), score "
        f"{metrics['dense_score_median']:.3f}"
    ]
    unit = _unit_of(metrics, "dense_surface_median_")
    if unit is None:
        return lines
    near = f"{TYPICAL:g}_{unit}"
    line = f"dense against truth: {100.0 * metrics[f'dense_accuracy_within_{near}']:.1f} % of the points within "
    line += f"{TYPICAL:g} {unit} of the surface"
    complete = metrics.get(f"dense_completeness_within_{FOUND:g}_{unit}")
    if complete is not None:
        line += f", {100.0 * complete:.1f} % of the textured surface has one within {FOUND:g} {unit}"
    plane_rms = metrics.get(f"dense_plane_rms_{unit}")
    if plane_rms is not None:
        line += f", {plane_rms:.4f} {unit} RMS from its planes{without_outliers(metrics)}"
    return [*lines, line]
