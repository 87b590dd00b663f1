"""Which jobs of a sweep stand side by side in the figures of reconstructions, and what the files are called."""

import re
from collections.abc import Sequence

from torchrefrac.files.run import RunRecord
from torchrefrac.sweeps.design import METHOD, Design, has_paper_form

MOST_PANELS = 6  # side by side
FIGURES = ("figure1", "dense_figure1", "dense_error_map")


def shown_together(jobs: Sequence[RunRecord], design: Design) -> dict[str, list[RunRecord]]:
    """The complete jobs that share a figure, by what ends the name of its file, such as `_tank_1.2.png`.

    They have one capture and differ in model or dense method alone; of seeds the first is taken. A figure has at least
    2 jobs (1 where only scene, model and dense method vary) and at most 6.
    """
    others = [key for key in design.keys if key not in (*METHOD, *design.averaged)]
    groups: dict[tuple[str, ...], list[RunRecord]] = {}
    for job in jobs:
        if job.is_complete:
            values = tuple(job.overrides.get(key, "") for key in others)
            groups.setdefault((str(job.capture or ""), job.scene, *values), []).append(job)
    if design.averaged:
        groups = {group: _first_of_each(members) for group, members in groups.items()}
    fewest = 1 if has_paper_form(design) else 2
    shown = {group: members for group, members in groups.items() if fewest <= len(members) <= MOST_PANELS}
    if len(groups) == 1 and shown:
        return {".png": next(iter(shown.values()))}
    named: dict[str, list[RunRecord]] = {}
    for (_, *words), members in shown.items():
        stem = "_".join(_fit_for_a_file(word) for word in words if word)
        end, number = f"_{stem}.png", 2
        while end in named:
            end, number = f"_{stem}_{number}.png", number + 1
        named[end] = members
    return named


def _first_of_each(jobs: Sequence[RunRecord]) -> list[RunRecord]:
    first: dict[tuple[str, str], RunRecord] = {}
    for job in jobs:
        first.setdefault((job.model, str(job.metrics.get("dense_method", ""))), job)
    return list(first.values())


def _fit_for_a_file(word: str) -> str:
    return re.sub(r"[^\w.+-]+", "-", word).strip("-.") or "-"
