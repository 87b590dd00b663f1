"""The numbers of the paper (Chang & Chen, ICCV 2011) beside those of runs: its Table 1, and sentences about it."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from torchrefrac.files.run import RunRecord
from torchrefrac.html.run_page import report_link
from torchrefrac.html.tables import Cell, Entry, Table, table1
from torchrefrac.html.words import UNKNOWN, model_order, model_title, rounded

PAPER = {"none": 1.062, "radial": 0.717, "refractive": 0.025}
"""Errors of the cameras in the paper's Table 1, RMS, cm. Those without refraction are Bundler's."""
DIGITS = 3
"""Of errors in tables, as the paper has them."""
SYNTHETIC, PHOTOGRAPHED = "tank", "cans"
"""The scenes made after the paper's synthetic experiment (section 4.1) and after its real one (4.2)."""

Records = Mapping[tuple[str, str], RunRecord]
"""Complete runs by their scene and model."""


def verdict(records: Records) -> str:
    """How much better the cameras are with refraction, here and in the paper."""
    ours = _camera_errors(records)
    if not {"none", "refractive"} <= ours.keys():
        return "There are no runs of the tank both with and without refraction to compare."
    paper, here = PAPER["none"] / PAPER["refractive"], ours["none"] / ours["refractive"]
    return (
        f"Cameras are off by {rounded(ours['refractive'])} cm with refraction and by {rounded(ours['none'], 3)} cm "
        f"without, {here:.0f} times as much; in the paper it is {PAPER['refractive']} and {PAPER['none']} cm, "
        f"{paper:.0f} times."
    )


def explained(records: Records) -> str:
    """How much of the difference between our radial model and the paper's cameras as Bundler's explain.

    Empty without runs of both on the tank.
    """
    ours, points = _camera_errors(records), _numbers(records, "point_median_cm")
    if not {"radial", "bundler"} <= ours.keys():
        return ""
    gap, closed = ours["radial"] - PAPER["radial"], ours["radial"] - ours["bundler"]
    share = closed / gap if gap > 0.0 else 0.0
    found = f"{100.0 * min(share, 1.0):.0f} %" if share > 0.0 else "nothing"
    sentences = (
        "The paper's errors without refraction are Bundler's, which refines focal length and radial distortion of each "
        "photograph, where our other models have one camera, calibrated. With cameras as Bundler's ours are off by "
        f"{rounded(ours['bundler'], 3)} cm in place of {rounded(ours['radial'], 3)} cm (radial distortion alone), "
        f"where the paper has {PAPER['radial']} cm: that explains {found} of the difference. The rest remains open: "
        "textures and the path of the cameras are others here, and the paper does not say how Bundler was set."
    )
    if ours["bundler"] < ours["radial"] and points.get("bundler", 0.0) > points.get("radial", math.inf):
        off = (f"{rounded(points[model], 3)} cm" for model in ("bundler", "radial"))
        sentences += (
            f" Its cameras are nearer the truth, its points are not: they are off by {' in place of '.join(off)}."
        )
    return sentences


def table_of(records: Records, scene: str, folder: Path) -> Table | None:
    """Table 1 of a scene, with links from a page in `folder`; None without runs of it."""
    own = sorted((record for (name, _), record in records.items() if name == scene), key=model_order)
    if not own:
        return None
    entries = [Entry(model_title(one.model), one, report_link(one, folder)) for one in own]
    return table1(entries, own[0].length_unit, digits=DIGITS)


def table_beside_paper(records: Records, folder: Path) -> Table | None:
    """Table 1 of the synthetic scene, with a column of the paper's numbers after the models."""
    table = table_of(records, SYNTHETIC, folder)
    if table is None:
        return None
    numbers = {model_title(model): f"{error:.3f}" for model, error in PAPER.items()}
    rows = [[row[0], Cell(numbers.get(row[0].text, UNKNOWN)), *row[1:]] for row in table.rows]
    return replace(table, heads=[table.heads[0], "camera error, paper (cm)", *table.heads[1:]], rows=rows)


def _camera_errors(records: Records) -> dict[str, float]:
    """Of the synthetic scene by model, RMS, cm."""
    return _numbers(records, "camera_rms_cm")


def _numbers(records: Records, metric: str) -> dict[str, float]:
    """A metric of the runs of the synthetic scene, by model."""
    found = {model: record.number(metric) for (scene, model), record in records.items() if scene == SYNTHETIC}
    return {model: value for model, value in found.items() if value is not None}
