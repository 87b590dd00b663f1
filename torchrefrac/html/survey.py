"""What a report says of a survey: where it stands, how deep, how large and how exact."""

from collections.abc import Mapping, Sequence
from typing import Any

from torchrefrac.evaluate.survey_orders import NORMAL_95, ORDERS
from torchrefrac.html.contents import RunContents
from torchrefrac.html.tables import Cell, Table
from torchrefrac.html.words import interfaces, rounded, with_sigma

COMPARED = ("dx", "dy", "dz", "distance")
ORDER_NAMES = {"1": "1a and 1b"}


def survey_facts(run: RunContents) -> list[tuple[str, str]]:
    """What is known, and its value in words; empty where nothing of it is."""
    record, unit = run.record, run.unit
    number = record.number
    place = run.scene.georeference if run.scene is not None else None
    found: list[tuple[str, str]] = []
    if place is not None:
        found.append(("reference system", place.crs))
        found.append(("heights count from", place.vertical or "what the reference system says"))
    level = number(f"water_level_{unit}")
    if level is not None:
        found.append(("level of the water", f"{with_sigma(level, number(f'water_level_sigma_{unit}'))} {unit}"))
    slopes = [(number(f"water_slope_{name}_mm_per_m"), name) for name in ("east", "north")]
    rises = [
        f"{with_sigma(slope, number(f'water_slope_{name}_sigma_mm_per_m'))} mm/m to the {name}"
        for slope, name in slopes
        if slope is not None
    ]
    if rises:
        found.append(("the water rises by", ", ".join(rises)))
    land, rise = number(f"land_difference_median_{unit}"), number(f"land_rise_median_{unit}")
    if land is not None and rise is not None:
        words = f"{rounded(land)} {unit} in the median, {rounded(rise)} {unit} in height"
        found.append(("land, against a reconstruction without refraction", words))
    area, gsd = number(f"bed_area_{unit}2"), number(f"gsd_{unit}")
    if area is not None:
        found.append(("area of the bed", f"{rounded(area, 3)} {unit}²"))
    if gsd is not None:
        found.append(("a pixel on the bed", f"{rounded(gsd)} {unit} (median)"))
    middle, deepest = number(f"depth_median_{unit}"), number(f"depth_99_percent_{unit}")
    if middle is not None and deepest is not None:
        found.append(("depth", f"{rounded(middle, 3)} {unit} in the median, 99 % at most {rounded(deepest, 3)} {unit}"))
    sigma = number(f"bed_sigma_median_{unit}")
    if sigma is not None:
        words = f"{rounded(sigma)} {unit}, or {rounded(NORMAL_95 * sigma)} {unit} at 95 % (median)"
        found.append(("vertical uncertainty of the bed", words))
    return found


def order_table(run: RunContents) -> Table | None:
    """The share of the bed that each order of S-44 allows; None where it is not known."""
    shares = [(order, run.record.number(f"s44_{order.name}_percent")) for order in ORDERS]
    known = [(order, share) for order, share in shares if share is not None]
    if not known:
        return None
    rows = [
        [
            Cell(ORDER_NAMES.get(order.name, order.name)),
            Cell(f"{order.a:g} m"),
            Cell(f"{order.b:g}"),
            Cell(f"{share:g} %"),
        ]
        for order, share in known
    ]
    terms = (("a, b", "of the formula below"), ("of the bed's cells", "the share that is known as well as that"))
    return Table(["order of S-44", "a", "b", "of the bed's cells"], rows, terms=terms)


def compared_table(run: RunContents, kind: str) -> Table | None:
    """How far "control" or "check" points are from where they are stated, with the root mean squares below; None where
    there are none."""
    rows, unit = run.record.metrics.get(f"{kind}_points") or [], run.unit
    if not rows:
        return None
    cells = [[Cell(row["name"]), *(Cell(_off(row[axis])) for axis in COMPARED), Cell(_sigma(row))] for row in rows]
    rms = [run.record.number(f"{kind}_rms_{axes}_{unit}") for axes in ("xy", "z")]
    words = [rounded(value) if value is not None else "" for value in rms]
    cells.append([Cell("RMS"), Cell(f"xy {words[0]}"), Cell(""), Cell(words[1]), Cell(""), Cell("")])
    terms = (
        ("dx, dy, dz, distance", "where the reconstruction puts the point, less where it is stated to be"),
        ("sigma", "standard deviations of where the reconstruction puts it"),
    )
    return Table(["point", *(f"{name} ({unit})" for name in COMPARED), f"sigma x, y, z ({unit})"], cells, terms=terms)


def level_table(run: RunContents) -> Table | None:
    """What decided where the water stood; None where no level was stated."""
    sources = run.record.metrics.get("water_level_from") or []
    if not sources:
        return None
    rows = [
        [Cell(each["source"]), Cell(with_sigma(each["height"], each["sigma"])), Cell(f"{each['weight_percent']:.3g} %")]
        for each in sources
    ]
    terms = (
        ("height", "of the water, with its standard deviation"),
        ("weight", "its share in the level that was used"),
    )
    return Table(["level of the water by", f"height ({run.unit})", "weight"], rows, terms=terms)


def _off(value: float) -> str:
    return f"{value:.3g}"


def _sigma(row: Mapping[str, Any]) -> str:
    return ", ".join(f"{sigma:.2g}" for sigma in row.get("sigma", []))


def methods(run: RunContents) -> str:
    """A paragraph for the methods section of a report or paper; empty where the run has no dense surface."""
    record, scene = run.record, run.scene
    points, images = record.number("dense_points"), record.number("registered_images")
    if points is None or images is None or scene is None or record.model != "refractive":
        return ""
    of_kind, through = run.words, interfaces(run.capture)
    stated = f"{through}; " if through else ""
    words = [
        f"{images:.0f} photographs were reconstructed with refraction {of_kind.model} modelled in every step "
        f"(torchrefrac; {stated}index of refraction {scene.index_ratio:.4g} relative to air): "
        f"relative and absolute poses {of_kind.poses}, bundle adjustment of all poses and "
        f"points{_cameras(scene.cameras.names)}, and dense matching of surface patches along refracted rays "
        f"({points:.0f} points)."
    ]
    level, unit = record.number(f"water_level_{run.unit}"), run.unit
    if level is not None:
        sigma = record.number(f"water_level_sigma_{unit}")
        words.append(f"The level of the water was estimated as {with_sigma(level, sigma)} {unit}.")
    rms = [record.number(f"position_rms_{name}{unit}") for name in ("", "vertical_")]
    if rms[0] is not None and rms[1] is not None:
        words.append(
            f"Cameras agree with their measured positions to {rounded(rms[0])} {unit} horizontally and "
            f"{rounded(rms[1])} {unit} vertically (RMS)."
        )
    sigma = record.number(f"bed_sigma_median_{unit}")
    if sigma is not None:
        words.append(
            f"Standard deviations of the bed's heights, with what cameras and the water's level add, are "
            f"{rounded(sigma)} {unit} in the median."
        )
    return " ".join(words)


def _cameras(names: Sequence[str]) -> str:
    return f" ({len(names)} cameras)" if len(names) > 1 else ""
